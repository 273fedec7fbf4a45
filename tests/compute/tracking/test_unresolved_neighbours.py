"""Strangers: a peak that is no track's is expected in the track's own when it has gone into it."""

import numpy as np
from numpy.typing import NDArray

from compute.measurement.measurements import Measurements
from compute.tracking.settings import TrackerSettings
from compute.tracking.unresolved_neighbours import (
    NEIGHBOUR_FIELDS,
    any_neighbour,
    inflate_unresolved,
    predict_merged,
    update_neighbours,
)

Array = NDArray[np.float64]

SETTINGS = TrackerSettings()
STEP_S = 0.01
OWN = np.zeros((1, 1), dtype=np.int32)


def frame(*places_px: float) -> Measurements:
    """One sensor's peaks; the first is the track's own."""
    position = np.array([places_px])
    return Measurements.of(position, np.full(position.shape, 0.1))


def after(neighbours: Array, peaks: Measurements) -> Array:
    step = np.full(1, STEP_S)
    return update_neighbours(neighbours, OWN, peaks, peaks.usable, step, SETTINGS)


def hidden(neighbours: Array) -> bool:
    return bool(predict_merged(neighbours, np.full(1, STEP_S), SETTINGS)[0, 0])


def test_a_stranger_that_comes_near_is_hidden_then_and_comes_out_again() -> None:
    """By 3 px an exposure from 14 px away, merged within 4 px, seen again on the other side."""
    neighbours = np.zeros((1, 1, NEIGHBOUR_FIELDS))
    told = []
    for distance in np.arange(14.0, -14.0, -3.0).tolist():
        told.append((distance, hidden(neighbours)))
        seen = abs(distance) >= 4.0
        neighbours = after(neighbours, frame(500.0, 500.0 + distance) if seen else frame(500.0))
    assert [distance for distance, one in told if one] == [5.0, 2.0, -1.0, -4.0]
    assert neighbours[0, 0, 2] >= 2


def test_a_single_false_peak_hides_nowhere() -> None:
    neighbours = after(np.zeros((1, 1, NEIGHBOUR_FIELDS)), frame(500.0, 505.0))
    assert not hidden(neighbours)
    assert not after(neighbours, frame(500.0)).any()


def test_one_that_stops_being_seen_far_away_is_forgotten() -> None:
    neighbours = np.zeros((1, 1, NEIGHBOUR_FIELDS))
    for distance in (14.0, 13.0, 12.0):
        neighbours = after(neighbours, frame(500.0, 500.0 + distance))
    assert neighbours[0, 0, 2] == 3
    assert not after(neighbours, frame(500.0)).any()


def test_only_a_peak_that_is_alone_is_doubted() -> None:
    reading, there = np.array([[500.2]]), np.ones((1, 1), dtype=np.bool_)
    alone, two, far = frame(500.0), frame(500.0, 506.0), frame(500.0, 530.0)
    assert inflate_unresolved(alone, reading, there, SETTINGS).variance_px2[0, 0] > 1.0
    assert inflate_unresolved(two, reading, there, SETTINGS).variance_px2[0].max() < 0.02
    found = inflate_unresolved(far, reading, there, SETTINGS).variance_px2[0]
    assert found[0] > 1.0
    assert found[1] < 0.02
    assert inflate_unresolved(alone, reading, ~there, SETTINGS).variance_px2[0, 0] < 0.02


def test_whether_any_is_near() -> None:
    peaks = frame(500.0, 510.0, 900.0)
    free = np.array([[False, True, True]])
    assert any_neighbour(OWN, peaks, free, SETTINGS)
    assert not any_neighbour(OWN, peaks, np.array([[False, False, True]]), SETTINGS)
    assert not any_neighbour(-np.ones_like(OWN), peaks, free, SETTINGS)
