"""Many searches in one batch end where each ends alone."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from compute.calibration.single_sensor.camera_fit import minimise
from compute.calibration.single_sensor.lens_prior import LensPrior
from compute.camera.stack import CameraStack
from tests.compute.distorted_rig import distorted_rig, field_points, seen_readings
from tests.compute.rig import control_points, project, rig


def test_as_scipy_finds_it_with_distortion_and_prior() -> None:
    models, points = distorted_rig(((1, 2), (3, 0), (0, 2))), field_points(60)
    rng = np.random.default_rng(0)
    readings = seen_readings(models, points) + 0.3 * rng.standard_normal((60, 4))
    weights = np.where(np.isnan(readings), 0.0, 1.0 / rng.uniform(0.2, 0.4, (60, 4)))
    stack = CameraStack.of(models)
    start = stack.retract(1e-3 * rng.standard_normal((4, stack.width)) * [100.0] + 0.0)
    prior = LensPrior(
        np.zeros(4),
        stack.offset_mm[:, 1] + 20.0,
        np.full(4, 30.0),
        stack.principal_point_px + 3.0,
        np.full(4, 5.0),
        np.full(4, 0.4),
        np.full(4, 0.01),
    )
    ended = minimise(start, points, readings, weights, prior)
    assert ended.converged.all()
    scale = np.array([10.0, 10.0, 0.01, 0.01, 0.01, 10.0, 10.0, 10.0, 0.1, 0.1, 0.1])
    for row in range(4):
        one = stack.rows(np.array([row]))

        def residuals(step: np.ndarray, row: int = row, one: CameraStack = one) -> np.ndarray:
            moved = one.retract((step * scale)[None])
            misfit = (moved.project(points)[:, 0] - readings[:, row]) * weights[:, row]
            away = [
                (moved.offset_mm[0, 1] - prior.offset_mm[row]) / 30.0,
                (moved.principal_point_px[0] - prior.principal_point_px[row]) / 5.0,
            ]
            # 1 % of half the field at u = 0.4: both cubic terms, and 0.3 of it for v^2.
            away += (moved.coefficients[0] / [0.01 / 0.16, 0.01 / 0.16, 0.003 / 0.4]).tolist()
            return np.append(np.nan_to_num(misfit), away)

        found = least_squares(residuals, np.zeros(11), xtol=1e-14, ftol=1e-14, gtol=1e-14)
        assert ended.squares[row] == pytest.approx(2.0 * found.cost, rel=1e-8)
        assert ended.squares[row] <= 2.0 * found.cost * (1.0 + 1e-9)


def test_searches_do_not_mind_each_other() -> None:
    models, points = rig(), control_points(20)
    readings = project(models, points) + np.random.default_rng(0).standard_normal((20, 4))
    stack = CameraStack.of(models)
    together = minimise(stack, points, readings, np.ones((20, 4)))
    for row in range(4):
        alone = minimise(
            stack.rows(np.array([row])), points, readings[:, row : row + 1], np.ones((20, 1))
        )
        assert together.squares[row] == pytest.approx(alone.squares[0], rel=1e-12)


def test_a_start_with_points_behind_the_lens_is_left_alone() -> None:
    models, points = rig(), control_points(20)
    readings = project(models, points)
    stack = CameraStack.of(models)
    step = np.zeros((4, 7))
    step[1, 6] = -5000.0
    ended = minimise(stack.retract(step), points, readings, np.ones((20, 4)))
    assert ended.converged.tolist() == [True, False, True, True]
    assert np.isinf(ended.squares[1])
