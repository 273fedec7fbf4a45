"""Markers that are given to the tracker: followed at once, by their own peaks; bad ones refused."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import chi2

from compute.camera.stack import CameraStack
from compute.errors import InvalidParameter
from compute.measurement.measurements import Measurements
from compute.tracking.settings import TrackerSettings
from compute.tracking.track_batch import TrackBatch, TrackState
from compute.tracking.tracker import Tracker
from tests.compute.tracking.moving_markers import (
    MIDDLE_MM,
    PIXELS,
    Sensing,
    bar,
    peaks_of,
    swinging,
)

Array = NDArray[np.float64]

HZ = 200.0
AT_REST = np.diag([1.0] * 3 + [400.0] * 3)


def tracker(sensors: int = 4, **settings: Any) -> tuple[Tracker, CameraStack]:
    cameras = CameraStack.of(bar(sensors))
    return Tracker(cameras, TrackerSettings(**settings), pixels=(PIXELS,) * sensors), cameras


def step(one: Tracker, cameras: CameraStack, frame: int, places: Array, seed: int) -> TrackBatch:
    rng = np.random.default_rng([seed, frame])
    sensing = Sensing(missed=0.05, false_peaks=0.5, resolution_px=4.0)
    position, sigma, flags, _ = peaks_of(cameras, places, sensing, rng)
    return one.step(1 + round(frame / HZ * 1e9), Measurements.of(position, sigma, flags), None)


@pytest.mark.parametrize("sensors", [4, 6])
def test_given_markers_are_followed_from_the_first_exposure(sensors: int) -> None:
    """Ten on a bar, more than can be found in one exposure: each keeps its number."""
    one, cameras = tracker(sensors)
    rng = np.random.default_rng(sensors)
    places = swinging(10, np.arange(60) / HZ, 150.0, rng)
    velocity = (places[1] - places[0]) * HZ
    given = places[0] + rng.standard_normal((10, 3))
    numbers = one.add_prior_tracks(
        1, given, velocity + 20.0 * rng.standard_normal((10, 3)), AT_REST
    )
    assert numbers.tolist() == list(range(1, 11))
    squares = []
    for frame, now in enumerate(places):
        batch = step(one, cameras, frame, now, 1)
        rows = [int(np.flatnonzero(batch.identity == number)[0]) for number in numbers]
        assert (batch.state[rows] != TrackState.TENTATIVE).all()
        off = batch.position_mm[rows] - now
        if frame in (0, 59):
            for row, away in zip(rows, off, strict=True):
                squares.append(away @ np.linalg.solve(batch.covariance[row, :3, :3], away))
    assert (np.linalg.norm(off, axis=1) < 5.0).sum() >= 9
    assert np.median(squares) < chi2.ppf(0.9, 3)


def test_a_given_marker_that_is_not_there_ends() -> None:
    one, cameras = tracker(coast_s=0.1)
    one.add_prior_tracks(1, MIDDLE_MM[None], np.zeros((1, 3)), AT_REST)
    nobody = np.full((1, 3), np.nan)
    lengths = [len(step(one, cameras, frame, nobody, 2)) for frame in range(40)]
    assert lengths[:15] == [1] * 15
    assert lengths[-1] == 0


def test_tentative_tracks_of_the_same_marker_give_way_and_numbers_go_on() -> None:
    one, cameras = tracker()
    for frame in range(3):
        before = step(one, cameras, frame, MIDDLE_MM[None], 3)
    assert before.state.tolist() == [TrackState.TENTATIVE]
    time_ns = 1 + round(3e9 / HZ)
    numbers = one.add_prior_tracks(time_ns, MIDDLE_MM[None], np.zeros((1, 3)), AT_REST, marker=4)
    after = step(one, cameras, 3, MIDDLE_MM[None], 3)
    assert numbers[0] > before.identity[0]
    assert after.identity.tolist() == numbers.tolist()
    assert after.marker.tolist() == [4]


def test_a_marker_that_is_tracked_is_refused() -> None:
    one, cameras = tracker()
    one.add_prior_tracks(1, MIDDLE_MM[None], np.zeros((1, 3)), AT_REST)
    step(one, cameras, 0, MIDDLE_MM[None], 4)
    far = MIDDLE_MM + np.array([60.0, 0.0, 0.0])
    with pytest.raises(InvalidParameter, match=r"marker 1 at .* may be track 1"):
        one.add_prior_tracks(1, np.stack([far, MIDDLE_MM]), np.zeros((2, 3)), AT_REST)
    assert one.add_prior_tracks(1, far[None], np.zeros((1, 3)), AT_REST).tolist() == [2]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"time_ns": 99}, "time_ns is 99, the exposure or start before was at 100"),
        ({"position_mm": np.zeros(3)}, r"position_mm has the shape \(3,\)"),
        ({"velocity_mm_s": np.zeros((2, 3))}, r"velocity_mm_s has the shape \(2, 3\)"),
        ({"covariance": np.eye(9)}, r"covariance has the shape \(9, 9\); it must be \(1, 6, 6\)"),
        ({"covariance": np.zeros((6, 6))}, "has the eigenvalue 0; all must be above 0"),
        ({"covariance": np.eye(6) + np.eye(6, k=1)}, "off its transpose by 1"),
        ({"covariance": np.full((6, 6), np.nan)}, "covariance of marker 0 is not finite"),
        ({"position_mm": np.full((1, 3), np.inf)}, "marker 0 is at .* all must be finite"),
        ({"marker": -1}, "marker is -1 for 1 markers"),
    ],
)
def test_bad_starts_are_refused_with_their_value(change: dict[str, Any], message: str) -> None:
    one, _ = tracker()
    given: dict[str, Any] = {
        "time_ns": 100,
        "position_mm": MIDDLE_MM[None],
        "velocity_mm_s": np.zeros((1, 3)),
        "covariance": AT_REST,
    }
    one.add_prior_tracks(100, MIDDLE_MM[None] + 200.0, np.zeros((1, 3)), AT_REST)
    with pytest.raises(InvalidParameter, match=message):
        one.add_prior_tracks(**(given | change))


def test_no_exposure_before_what_is_given() -> None:
    one, cameras = tracker()
    one.add_prior_tracks(10**9, MIDDLE_MM[None], np.zeros((1, 3)), AT_REST)
    with pytest.raises(InvalidParameter, match="markers were given for 1000000000"):
        step(one, cameras, 0, MIDDLE_MM[None], 5)
