"""Projection of points by the metric camera, and its derivatives."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.typing import NDArray

from compute.camera.model import SensorGeometry, SensorModel
from compute.camera.stack import CameraStack

GEOMETRY = SensorGeometry("s", 2048)
Array = NDArray[np.float64]


def floats(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high, allow_nan=False)


@st.composite
def models(draw: st.DrawFn) -> SensorModel:
    angle = draw(floats(0.0, 3.1))
    axis = np.array([draw(floats(-1, 1)) for _ in range(3)])
    assume(np.linalg.norm(axis) > 0.1)
    x, y, z = axis / np.linalg.norm(axis) * angle
    return SensorModel(
        "s",
        2048,
        draw(floats(100.0, 20_000.0)),
        draw(floats(-500.0, 2500.0)),
        (float(x), float(y), float(z)),
        draw(floats(-2000.0, 2000.0)),
        draw(floats(-3000.0, 3000.0)),
    )


def scene(model: SensorModel, seed: int = 3) -> Array:
    """World points in front of the camera, within its field."""
    rng = np.random.default_rng(seed)
    depth = rng.uniform(300.0, 3000.0, 20)
    sensor = np.column_stack(
        [rng.uniform(-0.4, 0.4, 20) * depth, rng.uniform(-0.4, 0.4, 20) * depth, depth]
    )
    sensor[:, 0] -= model.offset_x_mm
    sensor[:, 2] -= model.offset_z_mm
    points: Array = sensor @ model.rotation
    return points


def readings(model: SensorModel, points: Array) -> Array:
    projected: Array = CameraStack.of([model]).project(points)[:, 0]
    return projected


@given(models())
def test_projection_is_the_pinhole_of_the_docstring(model: SensorModel) -> None:
    points = scene(model)
    moved = points @ model.rotation.T
    x, z = moved[:, 0] + model.offset_x_mm, moved[:, 2] + model.offset_z_mm
    expected = model.principal_point_px + model.principal_distance_px * x / z
    assert np.allclose(readings(model, points), expected, rtol=0, atol=1e-6)


@given(models())
def test_points_behind_the_lens_have_no_reading(model: SensorModel) -> None:
    points = scene(model)
    lens = -model.offset_x_mm * model.rotation[0] - model.offset_z_mm * model.rotation[2]
    assert np.isnan(readings(model, 2.0 * lens - points)).all()


@given(models())
def test_jacobians_are_the_derivatives(model: SensorModel) -> None:
    points = scene(model)
    stack = CameraStack.of([model])
    _, slope = stack.linearise(points)
    parameter_slope = stack.parameter_jacobian(points)
    for axis in range(3):
        step = np.zeros(3)
        step[axis] = 1e-3
        numeric = (readings(model, points + step) - readings(model, points - step)) / 2e-3
        assert_close(slope[:, 0, axis], numeric)
    for index, size in enumerate([1e-3, 1e-3, 1e-7, 1e-7, 1e-7, 1e-3, 1e-3]):
        change = np.zeros(7)
        change[index] = size
        numeric = (
            readings(model.retract(change), points) - readings(model.retract(-change), points)
        ) / (2 * size)
        assert_close(parameter_slope[:, 0, index], numeric)


def test_cubic_term_corrects_the_reading() -> None:
    model = SensorModel("s", 2048, 3000.0, 1000.0, (0.0, 0.0, 0.0), 0.0, 1000.0, 2e-9)
    stack = CameraStack.of([model])
    reading = np.array([[400.0]])
    assert stack.add_cubic_term(reading)[0, 0] == pytest.approx(400.0 + 2e-9 * (-600.0) ** 3)
    slope = (stack.add_cubic_term(reading + 0.5) - stack.add_cubic_term(reading - 0.5))[0, 0]
    assert stack.correction_derivative(reading)[0, 0] == pytest.approx(slope, rel=1e-6)


def assert_close(found: Array, expected: Array) -> None:
    scale = max(1.0, float(np.abs(expected).max()))
    assert np.allclose(found, expected, rtol=0, atol=2e-5 * scale)


def assert_same(found: SensorModel, expected: SensorModel, tolerance: float = 1e-8) -> None:
    assert found.principal_distance_px == pytest.approx(
        expected.principal_distance_px, rel=tolerance
    )
    scale = expected.principal_distance_px + abs(expected.principal_point_px)
    assert found.principal_point_px == pytest.approx(
        expected.principal_point_px, abs=tolerance * scale
    )
    assert np.allclose(found.rotation, expected.rotation, atol=10 * tolerance)
    far = 1.0 + abs(expected.offset_x_mm) + abs(expected.offset_z_mm)
    assert found.offset_x_mm == pytest.approx(expected.offset_x_mm, abs=tolerance * far * 10)
    assert found.offset_z_mm == pytest.approx(expected.offset_z_mm, abs=tolerance * far * 10)
