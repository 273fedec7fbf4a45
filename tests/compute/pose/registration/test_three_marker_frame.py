"""The frame of three markers, as printed and as it has to be."""

import numpy as np
import pytest
from hypothesis import assume, given, settings

from compute.errors import (
    CollinearPoints,
    DuplicatePoint,
    InvalidParameter,
    NonFiniteValue,
    UndeterminedParameters,
)
from compute.pose.registration.three_marker_frame import (
    MAX_ROTATION_SIGMA_RAD,
    MIN_HEIGHT,
    three_marker_frame,
)
from compute.transform import Transform
from tests.compute.pose.motions import (
    Array,
    check_mean,
    drawn,
    point_covariance,
    transforms,
    vectors,
)

MARKERS = np.array([[10.0, 20.0, 1500.0], [110.0, 30.0, 1490.0], [80.0, 120.0, 1520.0]])


def test_the_printed_axes_are_left_handed_and_ours_are_their_mirror_in_y() -> None:
    """Figure 7.6: x = i, z = i x j, y = i x k."""
    i, j = MARKERS[1] - MARKERS[0], MARKERS[2] - MARKERS[1]
    k = np.cross(i, j)
    printed = np.stack([i, np.cross(i, k), k], axis=1)
    printed /= np.linalg.norm(printed, axis=0)
    assert np.linalg.det(printed) == pytest.approx(-1.0)
    found = three_marker_frame(MARKERS)
    assert np.allclose(found.rotation, printed * [1.0, -1.0, 1.0])
    assert np.linalg.det(found.rotation) == pytest.approx(1.0)


def assume_size(markers: Array) -> None:
    """Take no triangle smaller than 0.1 mm: moved by a metre, one of 1e-28 mm is a point.

    Coordinates of up to 1.6 m are rounded by 1.2e-13 mm, which turns the normal of a triangle
    0.002 mm high by 6e-11 rad. Those of up to 0.2 m, by 1.5e-14 mm, change slopes over 1e-6 of
    0.1 mm by 1.5e-14 / 1e-7 / 0.02, 8e-6 of themselves.
    """
    assume(np.ptp(markers, axis=0).max() > 0.1)


@given(vectors(300.0), vectors(300.0), vectors(300.0), transforms(covariance=False))
def test_it_goes_with_its_markers(a: Array, b: Array, c: Array, motion: Transform) -> None:
    markers = np.array([a, b, c])
    assume_size(markers)
    try:
        found = three_marker_frame(markers)
    except (CollinearPoints, DuplicatePoint):
        return
    # M1 is the origin, M2 on x, M3 in the plane z = 0 where y is positive.
    inside = found.inverse().apply(markers)
    length = np.abs(markers).max() + 1.0
    assert np.allclose(inside[0], 0.0, atol=1e-9 * length)
    assert np.allclose(inside[1, 1:], 0.0, atol=1e-9 * length)
    assert inside[1, 0] > 0.0
    assert abs(inside[2, 2]) < 1e-9 * length
    assert inside[2, 1] > 0.0
    moved, wanted = three_marker_frame(motion.apply(markers)), motion @ found
    assert np.allclose(moved.rotation, wanted.rotation, atol=1e-6)
    assert np.allclose(moved.translation_mm, wanted.translation_mm, atol=1e-6)


@settings(max_examples=20)
@given(vectors(200.0), vectors(200.0), vectors(200.0))
def test_the_covariance_is_by_the_slopes(a: Array, b: Array, c: Array) -> None:
    markers = np.array([a, b, c])
    assume_size(markers)
    try:
        here = three_marker_frame(markers)
    except (CollinearPoints, DuplicatePoint):
        return
    step = 1e-6 * np.linalg.norm(markers - markers.mean(axis=0))
    jacobian = np.array(
        [
            three_marker_frame(markers + step * one.reshape(3, 3)).difference(here) / step
            for one in np.eye(9)
        ]
    ).T
    mixed = step * np.random.default_rng(0).normal(size=(9, 9))
    found = three_marker_frame(markers, mixed @ mixed.T).covariance
    wanted = jacobian @ mixed @ mixed.T @ jacobian.T
    scale = np.sqrt(np.diag(wanted))
    assert found is not None
    assert np.allclose(found / np.outer(scale, scale), wanted / np.outer(scale, scale), atol=1e-3)


def test_the_covariance_is_what_the_frame_errs_by() -> None:
    squares = []
    truth = three_marker_frame(MARKERS)
    for seed in range(200):
        chance = np.random.default_rng(seed)
        covariances = np.array([point_covariance(chance, 0.3) for _ in range(3)])
        found = three_marker_frame(MARKERS + drawn(chance, covariances), covariances)
        error = found.difference(truth)
        assert found.covariance is not None
        squares.append(error @ np.linalg.solve(found.covariance, error))
    check_mean(squares, 6, 0.02)


def test_what_makes_no_frame_is_told_with_values() -> None:
    line = np.array([[0.0, 0.0, 0.0], [100.0, 0.0, 0.0], [250.0, 0.0, 0.0]])
    with pytest.raises(CollinearPoints, match="0 mm of a line 250 mm long"):
        three_marker_frame(line)
    line[1, 1] = 0.99 * MIN_HEIGHT * 250.0
    with pytest.raises(CollinearPoints, match=r"4\.95 mm of a line 250 mm .* 5 mm"):
        three_marker_frame(line)
    line[1, 1] = 1.01 * MIN_HEIGHT * 250.0
    three_marker_frame(line)
    for first, second in ((0, 1), (1, 2), (0, 2)):
        same = MARKERS.copy()
        same[second] = same[first]
        with pytest.raises(DuplicatePoint, match=f"M{first + 1} and M{second + 1}"):
            three_marker_frame(same)
    with pytest.raises(InvalidParameter, match=r"\(4, 3\)"):
        three_marker_frame(np.zeros((4, 3)))
    with pytest.raises(NonFiniteValue, match="nan"):
        three_marker_frame(MARKERS * np.nan)
    with pytest.raises(InvalidParameter, match=r"\(3, 3\); it must be"):
        three_marker_frame(MARKERS, np.eye(3))


def test_markers_too_near_one_another_for_their_noise_are_told() -> None:
    """M1 and M2 10 mm apart along x: their noise along y turns the frame about z, by its root 2."""
    markers = np.array([[0.0, 0.0, 0.0], [10.0, 0.0, 0.0], [0.0, 400.0, 0.0]])

    def noise(sigma_mm: float) -> Array:
        return np.broadcast_to(np.diag([1e-4, sigma_mm, 1e-4]) ** 2, (3, 3, 3))

    most = MAX_ROTATION_SIGMA_RAD * 10.0 / np.sqrt(2.0)
    found = three_marker_frame(markers, noise(0.99 * most))
    assert found.covariance is not None
    assert np.sqrt(found.covariance[2, 2]) == pytest.approx(0.99 * MAX_ROTATION_SIGMA_RAD)
    with pytest.raises(UndeterminedParameters, match=r"M1 and M2 10 mm.*\(.*1\.00\)") as caught:
        three_marker_frame(markers, noise(1.01 * most))
    assert caught.value.context["turn_rad"] == pytest.approx(1.01 * MAX_ROTATION_SIGMA_RAD)
