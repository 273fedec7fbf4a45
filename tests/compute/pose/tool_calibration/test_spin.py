"""Spin calibration: direction and place of the axis, and reasons where there is none."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from compute.errors import HighError, InvalidParameter, TooFewPoses, TooLittleRotation
from compute.pose.tool_calibration.spin import spin_calibration
from compute.transform import Transform, rotation_matrix
from tests.compute.pose.motions import (
    Array,
    check_mean,
    disturbed,
    pose_covariance,
    transforms,
    vectors,
)

AXIS = np.array([0.1, -0.2, 1.0]) / np.linalg.norm([0.1, -0.2, 1.0])
POINT = np.array([5.0, -3.0, 20.0]) - AXIS * (AXIS @ [5.0, -3.0, 20.0])


def spun(
    chance: np.random.Generator, poses: int = 40, half_deg: float = 60.0, tilt_rad: float = 0.0
) -> tuple[Array, Array]:
    """Return poses of a tool turned to and fro about its axis, along which it slides."""
    anywhere = rotation_matrix(chance.normal(size=3))
    turns = np.radians(chance.uniform(-half_deg, half_deg, poses))
    rotations = anywhere @ rotation_matrix(np.outer(turns, AXIS))
    rotations = rotations @ rotation_matrix(tilt_rad * chance.normal(size=(poses, 3)))
    slides = np.outer(chance.uniform(-30.0, 30.0, poses), anywhere @ AXIS)
    return rotations, np.array([10.0, 20.0, 1500.0]) - rotations @ POINT + slides


@settings(max_examples=30)
@given(st.integers(0, 1000), transforms(covariance=False))
def test_without_noise_it_is_exact_anywhere(seed: int, anywhere: Transform) -> None:
    rotations, translations = spun(np.random.default_rng(seed))
    found = spin_calibration(anywhere.rotation @ rotations, anywhere.apply(translations))
    assert np.allclose(found.direction, AXIS, atol=1e-8)
    assert np.allclose(found.point_mm, POINT, atol=1e-5)
    # In the world it is where every pose puts it.
    turned = anywhere.rotation @ rotations @ AXIS
    assert np.allclose(turned, found.world_direction, atol=1e-8)


def test_the_covariances_are_what_direction_and_point_err_by() -> None:
    directions, points, wrong = [], [], 0
    for seed in range(40):
        chance = np.random.default_rng(seed)
        poses = spun(chance)
        covariances = np.array([pose_covariance(chance) for _ in poses[0]])
        rotations, translations = disturbed(chance, *poses, covariances)
        out = np.sort(chance.choice(40, 3, replace=False))
        translations[out] += chance.uniform(5.0, 40.0, (3, 3))
        found = spin_calibration(rotations, translations, covariances)
        error = found.direction - AXIS
        directions.append(error @ np.linalg.pinv(found.direction_covariance, rcond=1e-6) @ error)
        error = found.point_mm - POINT
        points.append(error @ np.linalg.pinv(found.point_covariance_mm2, rcond=1e-6) @ error)
        wrong += found.outlying != tuple(out)
    # Two numbers of the direction; of the nearest point two, and what the direction makes of it.
    check_mean(directions, 2, 0.06)
    check_mean(points, 3, 0.06)
    # An error along the axis is none: a pose that only slid may stay in.
    assert wrong <= 3


def test_without_covariances_the_scatter_tells() -> None:
    directions, points = [], []
    for seed in range(40):
        chance = np.random.default_rng(seed)
        covariances = np.broadcast_to(np.diag([1e-6] * 3 + [0.01] * 3), (40, 6, 6))
        rotations, translations = disturbed(chance, *spun(chance), covariances)
        found = spin_calibration(rotations, translations)
        error = found.direction - AXIS
        directions.append(error @ np.linalg.pinv(found.direction_covariance, rcond=1e-6) @ error)
        error = found.point_mm - POINT
        points.append(error @ np.linalg.pinv(found.point_covariance_mm2, rcond=1e-6) @ error)
    check_mean(directions, 2, 0.06)
    check_mean(points, 3, 0.06)


@given(vectors(1.0))
def test_the_axis_points_along_what_is_asked(along: Array) -> None:
    poses = spun(np.random.default_rng(1), 12)
    length = np.linalg.norm(along)
    cosine = AXIS @ along / length if length > 0.0 else 0.0
    if abs(cosine) < 0.11:
        return
    assert np.sign(spin_calibration(*poses, along=along).direction @ AXIS) == np.sign(cosine)


def test_a_direction_across_the_axis_does_not_say_which_way() -> None:
    with pytest.raises(InvalidParameter, match="across the axis"):
        spin_calibration(*spun(np.random.default_rng(1)), along=np.array([2.0, 1.0, 0.0]))


def test_reasons_with_values() -> None:
    chance = np.random.default_rng(1)
    with pytest.raises(TooFewPoses, match=r"5 poses; .* at least 10"):
        spin_calibration(*spun(chance, 5))
    with pytest.raises(TooLittleRotation, match=r"at least 20\.0 deg"):
        spin_calibration(*spun(chance, half_deg=10.0))
    with pytest.raises(TooLittleRotation, match=r"span 0\.0 deg"):
        spin_calibration(*spun(chance, half_deg=0.0))
    with pytest.raises(HighError, match=r"single axis: .* tilted by") as caught:
        spin_calibration(*spun(chance, tilt_rad=0.1))
    assert 5.0 < caught.value.context["tilt_deg"] < 12.0  # type: ignore[operator]
    rotations, translations = spun(chance)
    with pytest.raises(HighError, match="did not stay at one position"):
        spin_calibration(rotations, translations + 5.0 * chance.normal(size=(40, 3)))
