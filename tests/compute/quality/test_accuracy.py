"""Single-point and point-to-point tests recover what was simulated."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from compute.errors import InvalidParameter, TooFewPoints
from compute.quality.accuracy import MarkerTrack, error_statistics, point_to_point, single_point

COVARIANCE = np.diag([0.01, 0.01, 0.09])


def noise(count: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).multivariate_normal(np.zeros(3), COVARIANCE, count)


def test_statistics_of_errors() -> None:
    found = error_statistics(np.array([-3.0, 1.0, 2.0]))
    assert (found.count, found.mean, found.largest) == (3, 0.0, 3.0)
    assert found.rms == pytest.approx(np.sqrt(14 / 3))
    assert found.standard_deviation == pytest.approx(np.sqrt(7.0))
    with pytest.raises(TooFewPoints, match="1 values"):
        error_statistics(np.array([1.0]))


def test_a_still_marker_scatters_as_its_covariance_says() -> None:
    place = np.array([10.0, 20.0, 1500.0])
    found = single_point(
        place + noise(4000, 1),
        np.broadcast_to(COVARIANCE, (4000, 3, 3)),
        np.arange(4000) / 100.0,
        place + np.array([0.0, 3.0, 4.0]),
    )
    assert found.scatter.rms == pytest.approx(found.stated_mm, rel=0.05)
    assert found.axes_mm == pytest.approx((0.1, 0.1, 0.3), rel=0.05)
    assert found.bias == pytest.approx(5.0, abs=0.02)
    assert found.drift_mm_per_min < 4 * found.drift_sigma_mm_per_min


def test_a_marker_that_creeps_is_told() -> None:
    time_s = np.arange(600) / 10.0
    positions = noise(600, 2) + time_s[:, None] * [0.01, 0.0, 0.0]
    found = single_point(positions, np.broadcast_to(COVARIANCE, (600, 3, 3)), time_s)
    assert found.drift_mm_per_min == pytest.approx(0.6, abs=4 * found.drift_sigma_mm_per_min)
    assert found.drift_mm_per_min > 5 * found.drift_sigma_mm_per_min


def test_points_that_are_none_are_refused() -> None:
    with pytest.raises(InvalidParameter, match="not a number"):
        single_point(np.full((3, 3), np.nan), np.zeros((3, 3, 3)), np.arange(3.0))
    with pytest.raises(TooFewPoints):
        single_point(np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0))
    with pytest.raises(TooFewPoints, match="measured 2 times; at least 3"):
        # Two points leave the speed's standard deviation infinite, which JSON has no number for.
        single_point(np.eye(3)[:2], np.zeros((2, 3, 3)), np.arange(2.0))


def track(time_s: np.ndarray, positions: np.ndarray) -> MarkerTrack:
    return MarkerTrack(time_s, positions, np.broadcast_to(COVARIANCE, (len(time_s), 3, 3)))


def waved(count: int, seed: int, scale: float = 1.0) -> tuple[MarkerTrack, MarkerTrack]:
    """A bar of 200 mm that is waved, its ends lit in turn every 5 ms."""
    times = np.arange(2 * count) * 0.005
    middle = np.stack(
        [100 * np.sin(times), 50 * np.cos(1.3 * times), 1500 + 80 * np.sin(0.7 * times)], 1
    )
    direction = np.stack([np.cos(times), np.sin(times), 0 * times], 1)
    ends = [middle + side * 100.0 * scale * direction for side in (-1.0, 1.0)]
    first, second = (end + noise(2 * count, seed + k) for k, end in enumerate(ends))
    return track(times[::2], first[::2]), track(times[1::2], second[1::2])


def test_a_waved_bar_measures_its_length_and_the_errors_are_as_stated() -> None:
    found = point_to_point(*waved(3000, 5), 200.0, max_gap_s=0.011)
    assert found.errors.count >= 2990
    assert found.errors.mean == pytest.approx(0.0, abs=0.02)
    # Interpolation halves the variance of one end: that is in the covariance, too.
    assert 0.93 < found.normalised_square < 1.07
    assert found.extent_mm[0] == pytest.approx(200.0, rel=0.02)


def test_a_scale_that_is_wrong_is_seen_as_such() -> None:
    found = point_to_point(*waved(500, 6, scale=1.01), 200.0, 0.05)
    assert found.errors.mean == pytest.approx(2.0, abs=0.05)
    assert found.mean_sigma_mm == 0.05
    assert found.normalised_square > 10.0


@settings(deadline=None, max_examples=50)
@given(st.floats(-500, 500), st.floats(-500, 500), st.integers(2, 20))
def test_straight_motion_is_interpolated_exactly(vx: float, vz: float, count: int) -> None:
    velocity = np.array([vx, 20.0, vz])
    first_times = np.arange(count + 1) * 0.01
    second_times = first_times[:-1] + 0.004
    first = np.zeros(3) + first_times[:, None] * velocity
    second = np.array([0.0, 0.0, 120.0]) + second_times[:, None] * velocity
    found = point_to_point(track(first_times, first), track(second_times, second), 120.0)
    assert found.errors.count == count
    assert found.errors.largest < 1e-9


def test_gaps_are_not_bridged() -> None:
    times = np.array([0.0, 0.01, 1.0, 1.01])
    still = track(times, np.zeros((4, 3)))
    other = track(np.array([0.005, 0.5, 1.005, 2.0]), np.full((4, 3), [100.0, 0.0, 0.0]))
    found = point_to_point(still, other, 100.0, max_gap_s=0.02)
    assert found.errors.count == 2


def test_exact_times_need_no_neighbour() -> None:
    times = np.array([0.0, 1.0, 5.0])
    one, other = track(times, np.zeros((3, 3))), track(times, np.full((3, 3), [0.0, 7.0, 0.0]))
    assert point_to_point(one, other, 7.0, max_gap_s=0.1).errors.count == 3


@pytest.mark.parametrize("reference", [0.0, -1.0, np.nan, np.inf])
def test_a_distance_that_is_none_is_refused(reference: float) -> None:
    with pytest.raises(InvalidParameter, match="reference distance"):
        point_to_point(*waved(5, 1), reference)


def test_a_marker_that_was_not_seen_is_told() -> None:
    nothing = track(np.zeros(0), np.zeros((0, 3)))
    with pytest.raises(TooFewPoints, match="0 positions"):
        point_to_point(nothing, waved(5, 1)[1], 200.0)
