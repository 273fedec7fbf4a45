"""The digitising pointer: a point only while it is held still, with an honest covariance."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from compute.errors import InvalidParameter, NotStationary, TooFewPoses
from compute.pose.tool_calibration.digitising import (
    StationaryCapture,
    StationaryPoint,
    StationarySettings,
    average_stationary_tip,
)
from tests.compute.pose.motions import Array, check_mean

PLACE = np.array([10.0, -20.0, 1500.0])


def held(
    chance: np.random.Generator, count: int = 60, sigma_mm: float = 0.1
) -> tuple[Array, Array]:
    """Return times of 100 a second and positions of a tip that is held."""
    times = np.arange(count) * 10_000_000
    return times, PLACE + sigma_mm * chance.normal(size=(count, 3))


def test_the_mean_errs_by_its_covariance() -> None:
    squares = []
    for seed in range(300):
        found = average_stationary_tip(*held(np.random.default_rng(seed)))
        error = found.position_mm - PLACE
        squares.append(error @ np.linalg.solve(found.covariance_mm2, error))
    # The scatter is estimated too: by Hotelling's T^2 the mean is 3 * 59 / 56.
    check_mean([one * 56.0 / 59.0 for one in squares], 3, 0.02)


def test_what_all_positions_share_no_mean_makes_smaller() -> None:
    times, positions = held(np.random.default_rng(0))
    shared = np.diag([0.25, 0.04, 0.0])
    stated = np.broadcast_to(shared + 0.01 * np.eye(3), (60, 3, 3))
    found = average_stationary_tip(times, positions, stated)
    assert np.allclose(np.diag(found.covariance_mm2)[:2], [0.25, 0.04], rtol=0.15)
    assert found.covariance_mm2[2, 2] < 0.005
    # What is known to be shared is there even where the rest is stated as too small.
    small = np.broadcast_to(shared + 1e-6 * np.eye(3), (60, 3, 3))
    certain = average_stationary_tip(
        times, positions, small, shared_mm2=np.broadcast_to(shared, (60, 3, 3))
    )
    alone = average_stationary_tip(times, positions)
    assert np.allclose(certain.covariance_mm2, alone.covariance_mm2 + shared)
    # Stated as smaller than the scatter: the scatter counts.
    alone = average_stationary_tip(times, positions, stated * 1e-6)
    assert np.allclose(
        alone.covariance_mm2, average_stationary_tip(times, positions).covariance_mm2
    )


def test_noise_is_no_movement() -> None:
    """The bound on drift leaves one still capture of 10 000 aside, and noise of any size."""
    settings = StationarySettings(max_sigma_mm=5.0, max_drift_mm=0.001)
    for seed in range(300):
        average_stationary_tip(*held(np.random.default_rng(seed), sigma_mm=1.0), settings=settings)


def test_a_tip_that_moves_is_not_taken() -> None:
    times, positions = held(np.random.default_rng(0))
    slow = positions + np.outer(np.linspace(0.0, 0.6, 60), [0.0, 1.0, 0.0])
    with pytest.raises(NotStationary, match=r"moved by 0\.\d+ mm in 0\.59 s") as caught:
        average_stationary_tip(times, slow)
    assert caught.value.context["drift_mm"] == pytest.approx(0.6, abs=0.1)
    with pytest.raises(NotStationary, match="scattered by") as caught:
        average_stationary_tip(*held(np.random.default_rng(0), sigma_mm=0.5))
    assert caught.value.context["sigma_mm"] == pytest.approx(0.5 * np.sqrt(3.0), rel=0.2)


def test_too_little_of_it() -> None:
    times, positions = held(np.random.default_rng(0))
    with pytest.raises(TooFewPoses, match="5 positions"):
        average_stationary_tip(times[:5], positions[:5])
    with pytest.raises(TooFewPoses, match=r"span 0\.19 s"):
        average_stationary_tip(times[:20], positions[:20])
    gap = np.r_[0:20, 40:60]
    with pytest.raises(TooFewPoses, match=r"not seen for 0\.21 s"):
        average_stationary_tip(times[gap], positions[gap])
    with pytest.raises(InvalidParameter, match="ascend"):
        average_stationary_tip(times[::-1], positions)
    with pytest.raises(TooFewPoses, match="0 positions"):
        average_stationary_tip(np.empty(0, np.int64), np.empty((0, 3)))


def taken(
    capture: StationaryCapture, times: Array, positions: list[Array | None]
) -> list[StationaryPoint]:
    found = []
    for time, position in zip(times, positions, strict=True):
        capture.add_sample(int(time), position)
        found.append(None if position is None else capture.take())
    return [one for one in found if one is not None]


def test_a_capture_waits_until_the_tip_rests_and_takes_it_once() -> None:
    chance = np.random.default_rng(0)
    times, positions = held(chance, 200)
    positions[:100] += np.outer(np.linspace(80.0, 0.0, 100), [1.0, 0.0, 0.0])
    capture = StationaryCapture()
    found = taken(capture, times[:155], [*positions[:155]])
    assert len(found) == 1
    # Of the way, at 80 mm/s, no more is in it than the limits let through.
    assert found[0].first_ns >= 94 * 10_000_000
    assert np.allclose(found[0].position_mm, PLACE, atol=0.3)
    # The next takes as long again.
    assert not taken(capture, times[155:190], [*positions[155:190]])


def test_a_capture_says_what_it_waits_for() -> None:
    capture = StationaryCapture()
    times, positions = held(np.random.default_rng(0), 100)
    assert "no position" in capture.reason
    taken(capture, times[:3], [*positions[:3]])
    assert "3 positions" in capture.reason
    taken(capture, times[3:30], [*positions[3:30]])
    assert "span 0.29 s" in capture.reason
    capture.add_sample(int(times[30]), None)
    assert "not seen" in capture.reason
    # Time that goes back begins anew.
    assert not taken(capture, times[:50], [*positions[:50]])
    assert taken(capture, times[50:51], [positions[50]])


@given(st.lists(st.booleans(), min_size=120, max_size=120), st.integers(0, 100))
def test_whatever_is_seen_a_point_comes_of_a_still_time_without_gaps(
    seen: list[bool], seed: int
) -> None:
    times, positions = held(np.random.default_rng(seed), 120)
    given_positions = [p if s else None for p, s in zip(positions, seen, strict=True)]
    for point in taken(StationaryCapture(), times, given_positions):
        inside = [
            int(t)
            for t, s in zip(times, seen, strict=True)
            if s and point.first_ns <= t <= point.last_ns
        ]
        assert len(inside) == point.poses
        assert max(np.diff(inside)) <= 100_000_000
        assert point.last_ns - point.first_ns >= 500_000_000


@pytest.mark.parametrize("wrong", [{"seconds": 0.0}, {"max_gap_s": np.nan}, {"min_poses": 3}])
def test_settings_that_mean_nothing(wrong: dict[str, float]) -> None:
    with pytest.raises(InvalidParameter, match=next(iter(wrong))):
        StationarySettings(**wrong)  # type: ignore[arg-type]
