"""The way through a window against a ray trace, scalar Snell, and differences of paths."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq, minimize_scalar

from compute.optics.coded_aperture.coded_window import CodedWindow
from compute.optics.coded_aperture.window_refraction import WindowPaths, trace_window
from compute.optics.tracing.assembly import Assembly, Lens
from compute.optics.tracing.reference_tracer import trace_rays
from compute.optics.tracing.surfaces import Aperture, Plane

GAPS = st.floats(1.0, 30.0)
THICKNESSES = st.floats(0.1, 10.0)
INDICES = st.floats(1.0, 2.5)
ACROSS = st.floats(-800.0, 800.0)
DEPTHS = st.floats(300.0, 4000.0)


def window(gap_mm: float, thickness_mm: float, index: float) -> CodedWindow:
    return CodedWindow((1,), 1.0, gap_mm, thickness_mm, index)


def path(made: CodedWindow, across: float, along: float, z: float) -> WindowPaths:
    return trace_window(made, np.array(across), np.array(along), np.array(z))


def snell_tangent(lateral: float, air: float, thickness: float, index: float) -> float:
    """Return tan t by bisection of the angle itself."""

    def excess(angle: float) -> float:
        inside = np.arcsin(np.sin(angle) / index)
        return float(air * np.tan(angle) + thickness * np.tan(inside) - lateral)

    return float(np.tan(brentq(excess, 0.0, 1.55, xtol=1e-15, rtol=1e-14)))


@given(gap=GAPS, thickness=THICKNESSES, index=INDICES, x=ACROSS, y=ACROSS, z=DEPTHS)
def test_a_traced_ray_meets_the_pixel(
    gap: float, thickness: float, index: float, x: float, y: float, z: float
) -> None:
    """The tracer's frame has z along the light and its origin on the plate's front."""
    made = window(gap, thickness, index)
    found = path(made, x, y, z)
    tangent = np.array([x, y]) * float(found.mask_fraction) / gap
    glass = Lens((Plane(), Plane()), (thickness,), (index,), Aperture(1e5, 1e5))
    stack = Assembly((glass,), thickness + gap).stack()
    rays = trace_rays(
        stack, np.array([[x, y, thickness - z]]), np.array([[-tangent[0], -tangent[1], 1.0]])
    )
    np.testing.assert_allclose(rays.position_mm[0, :2], 0.0, atol=1e-9)
    assert rays.transmittance.mean() == pytest.approx(float(found.transmittance), rel=1e-9)


@given(gap=GAPS, thickness=THICKNESSES, index=INDICES, x=ACROSS, y=ACROSS, z=DEPTHS)
def test_the_mask_is_crossed_where_snell_says(
    gap: float, thickness: float, index: float, x: float, y: float, z: float
) -> None:
    lateral = float(np.hypot(x, y))
    tangent = snell_tangent(lateral, z - thickness + gap, thickness, index)
    share = float(path(window(gap, thickness, index), x, y, z).mask_fraction)
    assert share * lateral == pytest.approx(gap * tangent, abs=1e-9)


def test_a_skew_ray_is_refracted_more_than_its_projection() -> None:
    made = window(10.0, 6.0, 1.5)
    flat = float(path(made, 300.0, 0.0, 1000.0).mask_fraction)
    skew = float(path(made, 300.0, 700.0, 1000.0).mask_fraction)
    assert abs(skew - flat) * 300.0 > 1e-3  # a tenth of a pixel of 10 um


@given(gap=GAPS, x=ACROSS, y=ACROSS, z=DEPTHS)
def test_without_a_plate_all_is_perspective(gap: float, x: float, y: float, z: float) -> None:
    found = path(CodedWindow((1,), 1.0, gap), x, y, z)
    r = np.sqrt(x**2 + y**2 + (z + gap) ** 2)
    assert float(found.mask_fraction) == pytest.approx(gap / (z + gap), rel=1e-12)
    assert float(found.density_sr_per_mm2) == pytest.approx((z + gap) / r**3, rel=1e-12)
    assert float(found.transmittance) == pytest.approx(1.0, abs=1e-12)


@settings(max_examples=40, deadline=None)
@given(thickness=THICKNESSES, index=INDICES, x=ACROSS, y=ACROSS, z=DEPTHS)
def test_the_solid_angle_is_that_between_rays_to_neighbouring_places(
    thickness: float, index: float, x: float, y: float, z: float
) -> None:
    made, step = window(10.0, thickness, index), 0.5

    def direction(at_x: float, at_y: float) -> np.ndarray:
        lateral = np.hypot(x - at_x, y - at_y)
        tangent = snell_tangent(lateral, z - thickness + 10.0, thickness, index)
        ray = np.array([(x - at_x) / lateral * tangent, (y - at_y) / lateral * tangent, 1.0])
        return np.asarray(ray / np.linalg.norm(ray))

    if np.hypot(x, y) < 5.0:
        x += 10.0
    along_x = (direction(step, 0.0) - direction(-step, 0.0)) / (2 * step)
    along_y = (direction(0.0, step) - direction(0.0, -step)) / (2 * step)
    expected = abs(direction(0.0, 0.0) @ np.cross(along_x, along_y))
    found = float(path(made, x, y, z).density_sr_per_mm2)
    assert found == pytest.approx(expected, rel=2e-5)


@settings(max_examples=25, deadline=None)
@given(thickness=st.floats(0.5, 10.0), index=INDICES, x=ACROSS, y=ACROSS, z=DEPTHS)
def test_the_curvature_is_that_of_the_optical_path(
    thickness: float, index: float, x: float, y: float, z: float
) -> None:
    gap, step = 10.0, 0.02
    made = window(gap, thickness, index)
    found = path(made, x, y, z)
    crossing = float(found.mask_fraction) * np.array([x, y])

    def length(at_x: float, at_y: float) -> float:
        lateral = float(np.hypot(x - at_x, y - at_y))
        tangent = snell_tangent(lateral, z - thickness, thickness, index)
        sine = tangent / np.sqrt(1.0 + tangent**2)
        outside = (z - thickness) * np.sqrt(1.0 + tangent**2)
        inside = index * thickness / np.sqrt(1.0 - (sine / index) ** 2)
        return float(outside + inside + np.sqrt(at_x**2 + at_y**2 + gap**2))

    def shortest(at_x: float) -> float:
        # At 75 deg the shortest way moves in y by up to 1.9 times the step in x.
        low, high = crossing[1] - 4.0 * step, crossing[1] + 4.0 * step
        best = minimize_scalar(
            lambda at_y: length(at_x, at_y),
            bounds=(low, high),
            method="bounded",
            options={"xatol": 1e-7},
        )
        return float(best.fun)

    middle = shortest(crossing[0])
    ends = shortest(crossing[0] + step) + shortest(crossing[0] - step)
    measured = (ends - 2.0 * middle) / step**2
    assert float(found.phase_curvature_per_mm) == pytest.approx(measured, rel=1e-3)
