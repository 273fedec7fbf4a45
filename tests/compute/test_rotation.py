"""Rotations and steps of many cameras at once."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from compute.camera.stack import CameraStack
from compute.transform import rotation_matrix, rotation_quaternion, rotation_vector
from tests.compute.distorted_rig import distorted_rig, field_points


@given(st.lists(st.floats(-4.0, 4.0), min_size=3, max_size=3), st.integers(0, 12))
def test_as_scipy_has_it(vector: list[float], tenths: int) -> None:
    w = np.array(vector) * 10.0**-tenths
    expected = Rotation.from_rotvec(w).as_matrix()
    assert np.allclose(rotation_matrix(w), expected, atol=1e-14)
    assert np.allclose(rotation_matrix(np.array([w, -w]))[1], expected.T, atol=1e-14)


@given(st.lists(st.floats(-1.0, 1.0), min_size=3, max_size=3), st.floats(0.0, np.pi))
def test_vectors_come_back(axis: list[float], angle: float) -> None:
    """Up to half a turn, where the sign of the axis is open."""
    length = np.linalg.norm(axis)
    w = np.array(axis) / (length if length > 1e-3 else 1.0) * angle
    found = rotation_vector(rotation_matrix(w))
    assert np.allclose(rotation_matrix(found), rotation_matrix(w), atol=1e-14)
    if np.linalg.norm(w) < 3.0:
        assert np.allclose(found, w, atol=1e-13)


@given(st.lists(st.floats(-4.0, 4.0), min_size=3, max_size=3))
def test_quaternions_as_scipy_has_them(vector: list[float]) -> None:
    rotation = Rotation.from_rotvec(vector)
    found = rotation_quaternion(rotation.as_matrix())
    expected = rotation.as_quat(canonical=True, scalar_first=True)
    assert found[0] >= 0.0
    # At half a turn the sign is open.
    assert min(np.abs(found - expected).max(), np.abs(found + expected).max()) < 1e-12


@given(st.integers(0, 2**32 - 1))
def test_a_stack_moves_as_its_cameras_do(seed: int) -> None:
    models = distorted_rig(((1, 2), (3, 0)))
    stack = CameraStack.of(models)
    rng = np.random.default_rng(seed)
    steps = rng.uniform(-1.0, 1.0, (4, stack.width)) * [50, 50, 0.3, 0.3, 0.3, 30, 30, 30, 0.1, 0.1]
    alone = CameraStack.of([m.retract(step) for m, step in zip(models, steps, strict=True)])
    moved = stack.retract(steps)
    points = field_points(20)
    assert np.allclose(moved.project(points), alone.project(points), atol=1e-8)
    again = CameraStack.of(moved.models(models))
    assert np.allclose(moved.project(points), again.project(points), atol=1e-8)
    some = np.array([2, 0])
    assert np.allclose(moved.rows(some).project(points), moved.project(points)[:, some])


@given(st.integers(0, 2**32 - 1))
def test_slopes_by_the_parameters(seed: int) -> None:
    """The Jacobian is what small steps do, and comes with the readings."""
    models = distorted_rig(((1, 2), (3, 0), (0, 2)), seed % 1000)
    stack, points = CameraStack.of(models), field_points(10, seed % 997)
    readings, slopes = stack.project_with_parameter_jacobian(points)
    assert np.array_equal(readings, stack.project(points))
    rng = np.random.default_rng(seed)
    direction = rng.uniform(-1.0, 1.0, (4, stack.width)) * [
        10,
        10,
        *[0.01] * 3,
        *[3] * 3,
        *[0.1] * 3,
    ]
    ahead, behind = (stack.retract(h * direction).project(points) for h in (1e-4, -1e-4))
    numeric = (ahead - behind) / 2e-4
    exact = np.einsum("nsp,sp->ns", slopes, direction)
    assert np.allclose(exact, numeric, rtol=1e-5, atol=1e-4)
