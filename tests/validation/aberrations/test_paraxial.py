"""Paraxial traces against textbook formulas and exact rays close to the axis."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from compute.errors import InvalidParameter
from compute.optics.tracing.reference_tracer import trace_rays
from compute.optics.tracing.surfaces import Conic, Cylinder, Plane, Surface, SurfaceStack
from tests.validation.aberrations.lenses import INDEX, SPHERES, lens_stack
from validation.aberrations.paraxial import ParaxialSystem, paraxial_system


def back_focal_distance_mm(system: ParaxialSystem) -> float:
    """Distance from the last vertex to the focus behind [mm]."""
    height, angle = system.trace(1.0, 0.0)
    return float(-height[-1] / angle[-1])


@pytest.mark.parametrize("name", SPHERES)
def test_thick_lens(name: str) -> None:
    """The lensmaker's equation of a thick lens, and its principal planes."""
    (front, back), t = SPHERES[name]
    c1, c2 = front.curvatures_per_mm[0], back.curvatures_per_mm[0]
    p1, p2 = (INDEX - 1.0) * c1, (1.0 - INDEX) * c2
    power = p1 + p2 - p1 * p2 * t / INDEX
    system = paraxial_system(lens_stack((front, back), t))
    f = 1.0 / power
    assert system.focal_length_mm == pytest.approx(f, rel=1e-12)
    expected = f * (1.0 - p1 * t / INDEX)
    assert back_focal_distance_mm(system) == pytest.approx(expected, rel=1e-12)


def test_the_lens_of_section_3_4() -> None:
    """Its focal length is 31.8 mm by its radius and index; the thesis says about 37 mm."""
    system = paraxial_system(lens_stack((Plane(), Cylinder(-16.54)), 4.0))
    assert system.focal_length_mm == pytest.approx(16.54 / 0.52, rel=1e-12)
    across = paraxial_system(lens_stack((Plane(), Cylinder(-16.54)), 4.0), "y")
    assert across.focal_length_mm == np.inf


@given(
    radius=st.floats(15.0, 80.0),
    back=st.floats(15.0, 80.0),
    thickness=st.floats(1.0, 6.0),
    distance=st.floats(300.0, 3000.0),
)
def test_rays_close_to_the_axis_go_to_the_paraxial_image(
    radius: float, back: float, thickness: float, distance: float
) -> None:
    stack = lens_stack((Conic(radius), Conic(-back)), thickness)
    system = paraxial_system(stack)
    image, magnification = system.image_of(-distance)
    pupil = 1e-3
    origin = np.array([[0.0, pupil, -distance]])
    ray = trace_rays(stack, origin, np.array([[pupil, -pupil, distance]]))
    slope = ray.direction[0, :2] / ray.direction[0, 2]
    place = ray.position_mm[0, :2] + slope * (image - system.image_mm)
    assert place == pytest.approx([0.0, magnification * pupil], abs=1e-6 * pupil)


def test_newton_and_pupils() -> None:
    """x x' = -f f', and a stop seen through the lens."""
    (shapes, t), f = SPHERES["biconvex"], 0.0
    system = paraxial_system(lens_stack(shapes, t, 12.0))
    f = system.focal_length_mm
    image, magnification = system.image_of(-700.0)
    behind = image - (t + back_focal_distance_mm(paraxial_system(lens_stack(shapes, t))))
    before = -700.0 - -back_focal_distance_mm(system.reversed())
    assert before * behind == pytest.approx(-(f**2), rel=1e-12)
    assert magnification == pytest.approx(f / before, rel=1e-12)
    pupil = system.entrance_pupil_mm(2)
    # The pupil is the stop's image by the lens met from behind.
    backwards = paraxial_system(lens_stack(shapes, t)).reversed()
    place, _ = backwards.image_of(-(12.0 - t))
    assert pupil == pytest.approx(t - place, rel=1e-12)


def test_what_is_refused() -> None:
    stack = lens_stack((Plane(), Conic(-16.54)), 4.0)
    tilted = SurfaceStack((Surface(Plane(), rotation_vector_rad=(0.1, 0.0, 0.0)),), stack.image)
    with pytest.raises(InvalidParameter, match="surface 0 is off the axis or tilted"):
        paraxial_system(tilted)
    with pytest.raises(InvalidParameter, match="surfaces is empty"):
        paraxial_system(SurfaceStack((), stack.image))
    with pytest.raises(InvalidParameter, match="stop is 7"):
        paraxial_system(stack).entrance_pupil_mm(7)
    with pytest.raises(InvalidParameter, match="the first vertex"):
        paraxial_system(stack).image_of(0.0)
