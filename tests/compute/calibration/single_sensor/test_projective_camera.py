"""The search of projective cameras: when the linear solution settles it, and from bad starts."""

from dataclasses import replace

import numpy as np
import pytest

from compute.calibration.single_sensor import projective_camera
from compute.calibration.single_sensor.projective_camera import search_from, search_starts
from compute.camera.stack import CameraStack
from tests.compute.rig import control_points, project, rig


def squares(matrices: np.ndarray, points: np.ndarray, readings: np.ndarray) -> np.ndarray:
    homogeneous = np.concatenate([points, np.ones((len(points), 1))], axis=1)
    first, second = matrices[:, 0] @ homogeneous.T, matrices[:, 1] @ homogeneous.T
    return np.asarray((((first / second).T - readings) ** 2).sum(axis=0))


@pytest.mark.parametrize(
    ("noise_px", "exchanged", "from_grid"),
    [(0.3, False, False), (200.0, False, True), (0.3, True, True)],
)
def test_the_grid_is_searched_where_noise_or_labels_leave_doubt(
    noise_px: float, exchanged: bool, from_grid: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    points = control_points(20)
    readings = project(rig(), points)
    readings += noise_px * np.random.default_rng(3).standard_normal(readings.shape)
    if exchanged:
        low, high = readings[:, 0].argmin(), readings[:, 0].argmax()
        readings[[low, high]] = readings[[high, low]]
    searched = []
    nodes = projective_camera.starting_cameras

    def count(camera, sensors, weights):  # type: ignore[no-untyped-def]
        searched.append(len(sensors))
        return nodes(camera, sensors, weights)

    monkeypatch.setattr(projective_camera, "starting_cameras", count)
    found = search_starts(points, readings, np.ones(readings.shape), None)
    assert sum(searched) == (readings.shape[1] if from_grid else 0)
    # In either case it ends no higher than the search from the grid.
    monkeypatch.setattr(projective_camera, "MAX_MISFIT_SHARE", -1.0)
    every = search_starts(points, readings, np.ones(readings.shape), None)
    assert (squares(found, points, readings) <= 1.00001 * squares(every, points, readings)).all()


def test_a_start_of_a_hundredth_of_the_principal_distance_reaches_the_minimum() -> None:
    points = control_points(20)
    readings = project(rig(), points) + 0.3 * np.random.default_rng(3).standard_normal((20, 4))
    wrong = [replace(m, principal_distance_px=0.01 * m.principal_distance_px) for m in rig()]
    assert (CameraStack.of(wrong).field_angles(points)[0] < np.inf).all()
    weights = np.ones(readings.shape)
    near = squares(search_from(points, readings, weights, rig()), points, readings)
    far = squares(search_from(points, readings, weights, wrong), points, readings)
    assert far == pytest.approx(near, rel=1e-6)
