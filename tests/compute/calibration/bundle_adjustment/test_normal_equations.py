"""Normal equations against finite differences and dense algebra."""

from dataclasses import replace

import numpy as np
import pytest

from compute.calibration.bundle_adjustment.normal_equations import (
    AdjustmentState,
    build_normal_equations,
    total_loss,
)
from compute.calibration.bundle_adjustment.pose_set import PoseSet
from compute.calibration.bundle_adjustment.sensor_prior import SensorPrior, step_between
from compute.calibration.bundle_adjustment.target_shape import (
    KnownDistance,
    TargetShape,
    body_shape,
    line_shape,
    point_shape,
)
from tests.compute.calibration.bundle_adjustment.scenes import (
    BODY,
    distorted_rig,
    nudged,
    nudged_models,
    posed,
)

SHAPES = {
    "point": point_shape(),
    "line": line_shape((0.0, 120.0, 300.0)),
    "line of uncertain places": line_shape((0.0, 120.0, 300.0), 0.2),
    "body": body_shape(BODY),
    "body of uncertain shape": body_shape(BODY, 0.1),
    "body of unknown shape": body_shape(BODY, np.inf, (KnownDistance(0, 1, 101.0, 0.05),)),
}


def _state(shape: TargetShape) -> tuple[AdjustmentState, SensorPrior]:
    rng = np.random.default_rng(3)
    models = distorted_rig()
    poses = nudged(posed(shape, 5, rng, models), rng)
    if shape.unknowns:
        poses = replace(poses, shape=shape.retract(0.3 * rng.standard_normal(shape.unknowns)))
    readings = poses.readings_px.copy()
    readings[1, 0, 2] = np.nan
    covariance = np.broadcast_to(np.diag([1.0, 2.0, 0.5]), (5, 3, 3))
    poses = replace(
        poses,
        readings_px=readings,
        known_mm=poses.translation_mm + rng.standard_normal((5, 3)),
        known_covariance_mm2=covariance,
    )
    other = nudged_models(models, rng)
    size = sum(model.parameter_count for model in models)
    root = rng.standard_normal((size, size))
    origins = rng.uniform(-300.0, 300.0, (len(models), 3))
    return AdjustmentState(other, (poses,)), SensorPrior(models, root @ root.T, origins)


@pytest.mark.parametrize("name", SHAPES)
def test_gradient_is_that_of_the_loss(name: str) -> None:
    state, prior = _state(SHAPES[name])
    weights = [np.ones(poses.readings_px.shape) for poses in state.pose_sets]
    equations = build_normal_equations(state, weights, prior)
    count = len(equations.gradient)
    scale = np.full(count, 1e-4)
    first = 0
    for model in state.models:
        scale[first + 2 : first + 5] = 1e-7
        first += model.parameter_count

    def loss(step: np.ndarray, local: np.ndarray) -> float:
        trial = state.retract(step, [local])
        return 0.5 * total_loss(trial, trial.residuals(), prior, np.inf)

    still = np.zeros((5, state.pose_sets[0].unknowns))
    for index in range(count):
        step = np.zeros(count)
        step[index] = scale[index]
        slope = (loss(step, still) - loss(-step, still)) / (2 * scale[index])
        size = max(abs(equations.gradient[index]), 1e-3 * float(np.abs(equations.gradient).max()))
        assert slope == pytest.approx(equations.gradient[index], abs=2e-4 * size)
    none = np.zeros(count)
    largest = float(np.abs(equations.blocks[0].gradient).max())
    for index in range(still.shape[1]):
        for pose in (1, 4):
            local = still.copy()
            local[pose, index] = 1e-6
            slope = (loss(none, local) - loss(none, -local)) / 2e-6
            expected = equations.blocks[0].gradient[pose, index]
            assert slope == pytest.approx(expected, rel=1e-5, abs=1e-6 * largest)


@pytest.mark.parametrize("name", SHAPES)
def test_reduced_equations_are_those_of_the_whole_matrix(name: str) -> None:
    """Poses eliminated or not, the globals' step and the poses' steps are the same."""
    state, prior = _state(SHAPES[name])
    weights = [np.ones(poses.readings_px.shape) for poses in state.pose_sets]
    equations = build_normal_equations(state, weights, prior)
    block = equations.blocks[0]
    poses, size, unknowns = block.mixed.shape
    whole = np.zeros((size + poses * unknowns,) * 2)
    whole[:size, :size] = equations.normal
    for pose in range(poses):
        own = slice(size + pose * unknowns, size + (pose + 1) * unknowns)
        whole[own, own] = block.normal[pose]
        whole[:size, own] = block.mixed[pose]
        whole[own, :size] = block.mixed[pose].T
    gradient = np.concatenate([equations.gradient, block.gradient.ravel()])
    expected = np.linalg.solve(whole, -gradient)
    reduced = equations.reduced()
    step = np.linalg.solve(reduced.normal, -reduced.gradient)
    local = reduced.local_steps(equations, step)[0]
    deviation = np.sqrt(np.diagonal(np.linalg.inv(whole)))
    assert np.abs(np.concatenate([step, local.ravel()]) - expected) == pytest.approx(
        0.0, abs=1e-5 * float(deviation.max())
    )
    assert ((np.concatenate([step, local.ravel()]) - expected) / deviation) == pytest.approx(
        0.0, abs=1e-4
    )


def test_step_between_is_the_step() -> None:
    models = distorted_rig()
    rng = np.random.default_rng(8)
    for model in models:
        step = 0.02 * rng.standard_normal(model.parameter_count)
        assert step_between(model, model.retract(step)) == pytest.approx(step, abs=1e-12)


def test_moving_a_line_along_its_axis_is_its_translation_only() -> None:
    """A turn about its own axis is no unknown of a line: no column of zeros."""
    poses = posed(line_shape((0.0, 300.0)), 3, np.random.default_rng(1), distorted_rig())
    assert poses.unknowns == 5
    slopes = poses.marker_jacobian()
    assert np.linalg.matrix_rank(slopes.reshape(3, 6, 5)).tolist() == [5, 5, 5]


def test_points_are_a_set_of_one_marker() -> None:
    positions = np.array([[0.0, 0.0, 1500.0], [10.0, 0.0, 1400.0]])
    poses = PoseSet.points(positions, np.zeros((2, 4)), np.ones((2, 4)))
    assert poses.marker_positions()[:, 0] == pytest.approx(positions)
    assert poses.unknowns == 3
