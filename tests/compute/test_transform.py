"""Transforms: a group, and covariances that go through it."""

import numpy as np
import pytest
from hypothesis import given, settings

from compute.errors import InvalidParameter, NonFiniteValue
from compute.pose.rigid_body import PoseStatus, ToolPose
from compute.transform import Transform, cross_matrix, nearest_rotation, rotation_matrix
from tests.compute.pose.motions import Array, pose_covariance, transforms, vectors


def close(one: Transform, other: Transform) -> None:
    assert np.allclose(one.rotation, other.rotation, atol=1e-12)
    assert np.allclose(one.translation_mm, other.translation_mm, atol=1e-8)


@settings(max_examples=40)
@given(transforms(), transforms(), transforms())
def test_a_group(a: Transform, b: Transform, c: Transform) -> None:
    close((a @ b) @ c, a @ (b @ c))
    close(a @ a.inverse(), Transform.identity())
    close((a @ b).inverse(), b.inverse() @ a.inverse())
    close(a @ Transform.identity(), a)


@given(transforms(), transforms(), vectors(500.0))
def test_it_takes_points_where_its_matrix_does(a: Transform, b: Transform, point: Array) -> None:
    assert np.allclose((a @ b).apply(point), a.apply(b.apply(point)), atol=1e-8)
    assert np.allclose(a.apply(point), (a.matrix @ [*point, 1.0])[:3], atol=1e-9)


@given(transforms(), transforms())
def test_covariances_are_the_same_whichever_way_they_go(a: Transform, b: Transform) -> None:
    for one, other in (
        (a.inverse().inverse(), a),
        ((a @ b).inverse(), b.inverse() @ a.inverse()),
    ):
        assert one.covariance is not None
        assert other.covariance is not None
        scale = np.sqrt(np.diag(other.covariance))
        assert np.allclose(
            one.covariance / np.outer(scale, scale),
            other.covariance / np.outer(scale, scale),
            atol=1e-6,
        )


@settings(max_examples=25)
@given(transforms(), transforms(), vectors(300.0))
def test_slopes_are_those_of_differences(a: Transform, b: Transform, point: Array) -> None:
    """Covariances are propagated by the derivatives of what they are propagated through."""
    step = 1e-5

    def nudged(one: Transform, axis: int) -> Transform:
        error = np.zeros(6)
        error[axis] = step
        turned = rotation_matrix(error[:3]) @ one.rotation
        return Transform(turned, one.translation_mm + error[3:], one.covariance)

    def jacobian(of: str) -> Array:
        columns = []
        for axis in range(6):
            moved = nudged(a, axis)
            if of == "inverse":
                columns.append(moved.inverse().difference(a.inverse()) / step)
            elif of == "product":
                columns.append((moved @ b).difference(a @ b) / step)
            else:
                columns.append((moved.apply(point) - a.apply(point)) / step)
        return np.array(columns).T

    assert a.covariance is not None
    exact = Transform(b.rotation, b.translation_mm)
    for of, found in (
        ("inverse", a.inverse().covariance),
        ("product", (a @ exact).covariance),
        ("point", a.point_covariance(point)),
    ):
        wanted = jacobian(of) @ a.covariance @ jacobian(of).T
        assert found is not None
        assert np.allclose(found, wanted, rtol=1e-3, atol=1e-3 * np.abs(wanted).max())


def test_the_second_of_a_product_is_turned_and_a_point_adds_its_own() -> None:
    chance = np.random.default_rng(3)
    a = Transform.from_rotation_vector(np.array([0.3, 1.0, -2.0]), np.array([10.0, 20.0, 30.0]))
    b = Transform(np.eye(3), np.array([100.0, 0.0, 50.0]), pose_covariance(chance))
    found = (a @ b).covariance
    assert found is not None
    assert b.covariance is not None
    assert np.allclose(found[3:, 3:], a.rotation @ b.covariance[3:, 3:] @ a.rotation.T)
    assert np.allclose(found[:3, 3:], a.rotation @ b.covariance[:3, 3:] @ a.rotation.T)
    own = np.diag([1.0, 2.0, 3.0])
    assert np.allclose(a.point_covariance(np.zeros(3), own), a.rotation @ own @ a.rotation.T)
    assert (a @ a).covariance is None


@pytest.mark.slow
@given(vectors(1.0), vectors(1.0))
def test_the_cross_matrix_crosses(one: Array, other: Array) -> None:
    assert np.allclose(cross_matrix(one) @ other, np.cross(one, other))


@given(transforms(covariance=False))
def test_the_nearest_rotation_is_never_a_reflection(a: Transform) -> None:
    for flat in (np.diag([1.0, 1.0, 0.0]), np.diag([2.0, 1.0, -0.5])):
        found = nearest_rotation(a.rotation @ flat)
        assert np.isclose(np.linalg.det(found), 1.0)
    assert np.allclose(nearest_rotation(3.0 * a.rotation), a.rotation)


def test_what_is_no_transform_is_refused() -> None:
    with pytest.raises(InvalidParameter, match="determinant is -1"):
        Transform(np.diag([1.0, 1.0, -1.0]), np.zeros(3))
    with pytest.raises(InvalidParameter, match=r"off the identity by 0\.21"):
        Transform(1.1 * np.eye(3), np.zeros(3))
    with pytest.raises(InvalidParameter, match=r"\(2,\); it must be \(3,\)"):
        Transform(np.eye(3), np.zeros(2))
    with pytest.raises(NonFiniteValue, match="nan"):
        Transform(np.eye(3), np.array([0.0, np.nan, 0.0]))


def test_a_pose_that_is_not_known_is_no_transform() -> None:
    lost = ToolPose("probe", PoseStatus.MISSING, "nothing was seen of it", 0, 17)
    with pytest.raises(InvalidParameter, match=r'"probe".*frame 17.*MISSING'):
        lost.transform()
    seen = ToolPose("probe", PoseStatus.OK, None, 0, 1, np.eye(3), np.ones(3), np.eye(6))
    assert np.array_equal(seen.transform().translation_mm, np.ones(3))
