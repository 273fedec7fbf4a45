"""Strangers: a peak that is no track's is expected in the track's own when it has gone into it."""

import numpy as np
from numpy.typing import NDArray

from compute.tracking.frame_peaks import FramePeaks
from compute.tracking.settings import TrackerSettings
from compute.tracking.strangers import FIELDS, any_near, beside_after, doubted, hidden_now

Array = NDArray[np.float64]

SETTINGS = TrackerSettings()
STEP_S = 0.01
OWN = np.zeros((1, 1), dtype=np.int32)


def frame(*places_px: float) -> FramePeaks:
    """One sensor's peaks; the first is the track's own."""
    position = np.array([places_px])
    shape = position.shape
    return FramePeaks.of(position, np.full(shape, 0.1), np.zeros(shape, np.int32), 1, SETTINGS)


def after(beside: Array, peaks: FramePeaks) -> Array:
    step = np.full(1, STEP_S)
    return beside_after(beside, OWN, peaks, peaks.usable, step, SETTINGS)


def hidden(beside: Array) -> bool:
    return bool(hidden_now(beside, np.full(1, STEP_S), SETTINGS)[0, 0])


def test_a_stranger_that_comes_near_is_hidden_then_and_comes_out_again() -> None:
    """By 3 px an exposure from 14 px away, merged within 4 px, seen again on the other side."""
    beside = np.zeros((1, 1, FIELDS))
    told = []
    for distance in np.arange(14.0, -14.0, -3.0).tolist():
        told.append((distance, hidden(beside)))
        seen = abs(distance) >= 4.0
        beside = after(beside, frame(500.0, 500.0 + distance) if seen else frame(500.0))
    assert [distance for distance, one in told if one] == [5.0, 2.0, -1.0, -4.0]
    assert beside[0, 0, 2] >= 2


def test_a_single_false_peak_hides_nowhere() -> None:
    beside = after(np.zeros((1, 1, FIELDS)), frame(500.0, 505.0))
    assert not hidden(beside)
    assert not after(beside, frame(500.0)).any()


def test_one_that_stops_being_seen_far_away_is_forgotten() -> None:
    beside = np.zeros((1, 1, FIELDS))
    for distance in (14.0, 13.0, 12.0):
        beside = after(beside, frame(500.0, 500.0 + distance))
    assert beside[0, 0, 2] == 3
    assert not after(beside, frame(500.0)).any()


def test_only_a_peak_that_is_alone_is_doubted() -> None:
    reading, there = np.array([[500.2]]), np.ones((1, 1), dtype=np.bool_)
    alone, two, far = frame(500.0), frame(500.0, 506.0), frame(500.0, 530.0)
    assert doubted(alone, reading, there, SETTINGS).variance_px2[0, 0] > 1.0
    assert doubted(two, reading, there, SETTINGS).variance_px2[0].max() < 0.02
    found = doubted(far, reading, there, SETTINGS).variance_px2[0]
    assert found[0] > 1.0
    assert found[1] < 0.02
    assert doubted(alone, reading, ~there, SETTINGS).variance_px2[0, 0] < 0.02


def test_whether_any_is_near() -> None:
    peaks = frame(500.0, 510.0, 900.0)
    free = np.array([[False, True, True]])
    assert any_near(OWN, peaks, free, SETTINGS)
    assert not any_near(OWN, peaks, np.array([[False, False, True]]), SETTINGS)
    assert not any_near(-np.ones_like(OWN), peaks, free, SETTINGS)
