"""Cameras with distortion: projection, Jacobians by finite differences, covariance layout."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from compute.camera.field_distortion import FieldDistortion
from compute.camera.model import PARAMETER_COUNT, SensorModel
from compute.camera.stack import CameraStack
from compute.errors import InvalidParameter
from tests.compute.rig import control_points, rig

TERMS = ((3, 0), (1, 2), (0, 2))


def _distorted(model: SensorModel, scale: float = 1.0, behind_mm: float = 37.0) -> SensorModel:
    coefficients = (-0.05 * scale, 0.08 * scale, 0.003 * scale)
    return replace(model, distortion=FieldDistortion(TERMS, coefficients, 12.0 * scale, behind_mm))


def test_distortion_is_the_formula() -> None:
    model = _distorted(rig()[1])
    points = control_points()
    frame = points @ model.rotation.T + [model.offset_x_mm, 12.0, model.offset_z_mm]
    u, v = frame[:, 0] / frame[:, 2], frame[:, 1] / (frame[:, 2] + 37.0)
    bent = u - 0.05 * u**3 + 0.08 * u * v**2 + 0.003 * v**2
    expected = model.principal_point_px + model.principal_distance_px * bent
    assert CameraStack.of([model]).project(points)[:, 0] == pytest.approx(expected, abs=1e-9)
    assert np.abs(expected - CameraStack.of([rig()[1]]).project(points)[:, 0]).max() > 0.1


def test_slopes_by_points_are_finite_differences() -> None:
    models = [rig()[0], _distorted(rig()[1]), _distorted(rig()[2], 2.0, 0.0)]
    stack = CameraStack.of(models)
    points = control_points()
    reading, slope = stack.linearise(points)
    assert reading == pytest.approx(stack.project(points), abs=1e-9)
    for axis in range(3):
        step = np.eye(3)[axis] * 1e-3
        rise = (stack.project(points + step) - stack.project(points - step)) / 2e-3
        assert slope[..., axis] == pytest.approx(rise, rel=1e-6, abs=1e-8)


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 2), st.floats(0.2, 3.0))
def test_slopes_by_parameters_are_finite_differences(sensor: int, scale: float) -> None:
    models = [_distorted(rig()[0], scale), rig()[1], _distorted(rig()[2], -scale)]
    models[2] = replace(models[2], distortion=FieldDistortion(((1, 2), (2, 2)), (0.1, -0.2), 3.0))
    stack = CameraStack.of(models)
    points = control_points(9)
    slopes = stack.parameter_jacobian(points)
    assert slopes.shape == (9, 3, PARAMETER_COUNT + 1 + 4)
    assert (slopes[:, ~stack.parameter_mask] == 0.0).all()
    model = models[sensor]
    assert len(model.parameter_names) == model.parameter_count
    own = slopes[:, sensor][:, np.argsort(_column_order(stack, sensor))]
    for column in range(model.parameter_count):
        size = 1e-6 if column in (2, 3, 4) else 1e-4
        step = np.eye(model.parameter_count)[column] * size
        up, down = (CameraStack.of([model.retract(sign * step)]) for sign in (1.0, -1.0))
        rise = (up.project(points) - down.project(points))[:, 0] / (2.0 * size)
        assert own[:, column] == pytest.approx(rise, rel=2e-5, abs=2e-5)


def _column_order(stack: CameraStack, sensor: int) -> np.ndarray:
    """Sort keys that bring a sensor's own columns first, in its own order."""
    places = stack.parameter_index[sensor]
    return np.where(places < 0, 10_000, places)


def test_a_covariance_is_spread_to_the_columns_of_its_parameters() -> None:
    swapped = replace(
        rig()[2], distortion=FieldDistortion(((1, 2), (3, 0)), (0.1, -0.2), 3.0, 37.0)
    )
    models = [_distorted(rig()[0]), rig()[1], swapped]
    stack = CameraStack.of(models)
    count = sum(model.parameter_count for model in models)
    root = np.random.default_rng(3).normal(size=(count, count))
    covariance = root @ root.T
    spread = stack.covariance_blocks(covariance)
    assert spread.shape == (3, stack.width, 3, stack.width)
    assert (spread[~stack.parameter_mask] == 0.0).all()
    # The variance of readings is the same by each sensor's own parameters, one after the other.
    slopes = stack.parameter_jacobian(control_points(5))
    first = 0
    for index, model in enumerate(models):
        block = slice(first, first + model.parameter_count)
        own = CameraStack.of([model]).parameter_jacobian(control_points(5))[:, 0]
        expected = np.einsum("np,pq,nq->n", own, covariance[block, block], own)
        found = np.einsum(
            "np,pq,nq->n", slopes[:, index], spread[index, :, index], slopes[:, index]
        )
        assert found == pytest.approx(expected, rel=1e-9)
        first += model.parameter_count


def test_a_step_moves_the_distortion() -> None:
    model = _distorted(rig()[0])
    moved = model.retract(np.arange(model.parameter_count) * 0.01)
    assert moved.distortion is not None
    assert moved.distortion.offset_y_mm == pytest.approx(12.0 + 0.07)
    assert moved.distortion.coefficients == pytest.approx((0.03, 0.17, 0.103))


def test_a_distortion_needs_one_coefficient_a_term() -> None:
    with pytest.raises(InvalidParameter, match="1 coefficients for 2 terms"):
        FieldDistortion(((3, 0), (1, 2)), (0.1,))
    with pytest.raises(InvalidParameter, match="roll"):
        FieldDistortion(((0, 1),), (0.1,))
