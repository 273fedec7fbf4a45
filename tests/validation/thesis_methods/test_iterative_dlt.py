"""The thesis's iterative DLT, [5.1]-[5.12]."""

import numpy as np
import pytest
from numpy.typing import NDArray

from compute.camera.stack import CameraStack
from compute.errors import NoConvergence
from compute.reconstruction.triangulation import triangulate_linear
from tests.compute.rig import control_points, geometry, project, rig
from validation.thesis_methods.dlt import model_from_matrix
from validation.thesis_methods.iterative_dlt import iterative_dlt

Array = NDArray[np.float64]


def distorted(ideal: Array, cubic: float, principal_point: float) -> Array:
    """Readings p with p + D (p - p0)^3 = ideal, by Newton's method."""
    reading = ideal.copy()
    for _ in range(50):
        offset = reading - principal_point
        reading -= (reading + cubic * offset**3 - ideal) / (1 + 3 * cubic * offset**2)
    return reading


@pytest.mark.parametrize("normalised", [False, True])
def test_exact_readings_need_no_distortion(normalised: bool) -> None:
    models, points = rig(1), control_points(19)
    readings = project(models, points)[:, 0]
    found = iterative_dlt(points, readings, "s1", normalised=normalised)
    # As published it squares the condition number: digits are lost, not the method.
    tolerance = 1e-6 if normalised else 0.1
    assert found.principal_point_px[-1] == pytest.approx(1023.5, abs=tolerance)
    assert found.cubic_per_px2 == pytest.approx(0.0, abs=1e-10)
    assert len(found.principal_point_px) == 30


def test_the_cubic_term_is_found() -> None:
    """A distortion of 2 px at the end of the line is recovered, and corrected when used."""
    models, points = rig(), control_points(60)
    cubic = 2e-9
    ideal = project(models, points)
    readings = distorted(ideal, cubic, 1023.5)
    fits = [iterative_dlt(points, column, "sensor") for column in readings.T]
    for fit in fits:
        assert fit.cubic_per_px2 == pytest.approx(cubic, rel=0.2)
    centre = points.mean(axis=0)
    stack = CameraStack.of(
        [
            model_from_matrix(fit.matrix, sensor, centre, cubic_per_px2=fit.cubic_per_px2)
            for fit, sensor in zip(fits, geometry(models), strict=True)
        ]
    )
    assert np.abs(stack.add_cubic_term(readings) - ideal).max() < np.abs(readings - ideal).max() / 3
    found = triangulate_linear(stack, stack.add_cubic_term(readings))
    plain = triangulate_linear(CameraStack.of(models), readings)
    assert np.abs(found - points).mean() < np.abs(plain - points).mean() / 3


@pytest.mark.parametrize("normalised", [False, True])
def test_both_arithmetics_find_the_same_distortion(normalised: bool) -> None:
    models, points = rig(1), control_points(60)
    ideal = project(models, points)[:, 0]
    readings = distorted(ideal, 2e-9, 1023.5)
    found = iterative_dlt(points, readings, "s1", iterations=300, normalised=normalised)
    assert found.cubic_per_px2 == pytest.approx(2e-9, rel=0.1)
    assert found.principal_point_px[-1] == pytest.approx(1023.5, abs=60.0)


def test_an_origin_in_the_lens_plane_is_beyond_the_published_form_only() -> None:
    """[5.1] sets the denominator's constant to 1; there it is 0 (Test 5.2)."""
    models, points = rig(1), control_points(19)
    readings = project(models, points)[:, 0]
    # Move the world so that its origin has depth 0.
    shift = models[0].offset_z_mm * models[0].rotation[2]
    moved = points + shift
    good = iterative_dlt(moved, readings, "s1", normalised=True)
    depth = good.matrix[1, :3] @ moved.T + good.matrix[1, 3]
    assert abs(good.matrix[1, 3] / depth.mean()) < 1e-8
    assert good.principal_point_px[-1] == pytest.approx(1023.5, abs=1e-6)
    try:
        published = iterative_dlt(moved, readings, "s1")
    except NoConvergence:
        return
    assert abs(published.principal_point_px[-1] - 1023.5) > 1e-3
