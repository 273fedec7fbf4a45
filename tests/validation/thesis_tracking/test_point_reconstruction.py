"""Points of equal tracks: a wrong reading is found out; which groups may be markers."""

import numpy as np
import pytest

from compute.camera.stack import CameraStack
from compute.reconstruction.correspondence.grouping import Correspondence
from compute.reconstruction.point_batch import PointBatch
from tests.compute.tracking.moving_markers import MIDDLE_MM, PIXELS, ring
from validation.thesis_tracking.point_reconstruction import SolvedPoints, SpacePoints
from validation.thesis_tracking.slot_tracker import SlotTracker

PLACE = MIDDLE_MM + np.array([30.0, -20.0, 50.0])


@pytest.fixture(scope="module")
def space() -> SpacePoints:
    return SpacePoints(CameraStack.of(ring(5)), None, None, (PIXELS,) * 5)


def solved(space: SpacePoints, wrong: dict[int, float], *, predicted: bool = True) -> SolvedPoints:
    readings = space.model.cameras.project(PLACE[None]).copy()
    for sensor, off in wrong.items():
        readings[0, sensor] += off
    # Predicted 1 mm off, as its covariance says.
    place = PLACE + 1.0 if predicted else np.full(3, np.nan)
    return space.solve(readings, np.full((1, 5), 0.05), place[None], np.eye(3)[None])


def test_the_reading_of_another_target_is_left_out(space: SpacePoints) -> None:
    for sensor in range(5):
        found = solved(space, {sensor: 20.0})
        assert found.left_out.tolist() == [sensor]
        assert not found.inconsistent[0]
        np.testing.assert_allclose(found.position_mm[0], PLACE, atol=1e-6)
    good = solved(space, {})
    assert (good.left_out[0], good.inconsistent[0]) == (-1, False)
    np.testing.assert_allclose(good.position_mm[0], PLACE, atol=1e-6)


def test_two_wrong_readings_and_a_marker_without_a_prediction_stay_in_doubt(
    space: SpacePoints,
) -> None:
    for found in (solved(space, {0: 20.0, 2: -35.0}), solved(space, {1: 20.0}, predicted=False)):
        assert found.inconsistent[0]
        assert found.left_out[0] == -1


def test_innovations_are_in_standard_deviations(space: SpacePoints) -> None:
    readings = space.model.cameras.project(PLACE[None]) + 0.3
    off = space.innovation(readings, np.full((1, 5), 0.1), PLACE[None], np.zeros((1, 3, 3)))
    np.testing.assert_allclose(off, 3.0, rtol=1e-6)
    jacobian = space.model.predict(PLACE[None]).jacobian_px_per_mm[0]
    wide = space.innovation(readings, np.full((1, 5), 0.1), PLACE[None], 0.01 * np.eye(3)[None])
    expected = 0.3 / np.sqrt(0.01 + 0.01 * (jacobian**2).sum(axis=1))
    np.testing.assert_allclose(wide[0], expected, rtol=1e-6)


def test_an_ambiguous_group_of_three_sensors_is_no_marker() -> None:
    peaks = np.array([[0, 0, 0, -1], [1, 1, -1, 1], [2, 2, 2, 2], [3, 3, 3, 3], [4, 4, 4, 4]])
    none = np.full(5, -1)
    groups = Correspondence(
        peaks.astype(float), np.ones((5, 4)), np.array([True, False, True, True, False]),
        PointBatch.empty(4), peaks, none, 0,
    )  # fmt: skip
    place = np.zeros((5, 3))
    place[4] = np.nan
    points = SolvedPoints(
        place, np.zeros((5, 3, 3)), np.array([False, False, False, True, False]),
        np.zeros(5, dtype=bool), none,
    )  # fmt: skip
    # Unambiguous, and agreed on by four; not the contradicted one, nor that without a point.
    assert SlotTracker._groups_to_take(groups, points) == [1, 2]
