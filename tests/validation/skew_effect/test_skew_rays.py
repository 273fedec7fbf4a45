"""Skew rays through cylinders against rays in the plane through stronger glass."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from compute.errors import InvalidParameter
from compute.optics.tracing.reference_tracer import RayStatus, trace_rays
from compute.optics.tracing.surfaces import Conic, Cylinder, Plane, Surface, SurfaceStack
from tests.validation.aberrations.lenses import INDEX, lens_stack
from validation.skew_effect.skew_rays import effective_index, in_plane_stack

ANGLE = st.floats(-0.6, 0.6)


@given(
    u=ANGLE,
    v=ANGLE,
    x=st.floats(-4.0, 4.0),
    turn=st.floats(-0.2, 0.2),
    front=st.floats(15.0, 60.0),
    conic=st.floats(-1.0, 0.5),
)
def test_a_skew_ray_goes_as_one_in_the_plane(
    u: float, v: float, x: float, turn: float, front: float, conic: float
) -> None:
    """Through a doublet turned about y, in x, in slope and in the place where it ends."""
    turned = (0.0, turn, 0.0)
    surfaces = (
        Surface(Cylinder(front, conic), (0.3, 0.0, 0.0), turned, 1.52),
        Surface(Cylinder(-20.0), (0.3, 0.0, 4.0), turned, 1.7),
        Surface(Plane(), (0.3, 0.0, 6.0), turned),
    )
    stack = SurfaceStack(surfaces, Surface(Plane(), (0.0, 0.0, 38.0)))
    direction = np.array([[u, v, 1.0]])
    origin = np.array([[x, 5.0, 0.0]]) - 100.0 * direction
    skew = trace_rays(stack, origin, direction)
    assume(skew.status[0] == RayStatus.ARRIVED)
    k = float(v / np.linalg.norm(direction))
    flat = np.array([[1.0, 0.0, 1.0]])
    plane = trace_rays(in_plane_stack(stack, k), origin * flat, direction * flat)
    assert plane.status[0] == RayStatus.ARRIVED
    assert skew.position_mm[0, 0] == pytest.approx(plane.position_mm[0, 0], abs=1e-9)
    slope = skew.direction[0, 0] / skew.direction[0, 2]
    assert slope == pytest.approx(plane.direction[0, 0] / plane.direction[0, 2], abs=1e-9)


@given(u=ANGLE, v=ANGLE)
def test_index_by_field_angles(u: float, v: float) -> None:
    """The closed form is the one that the stack is given, and never below that of the glass."""
    stack = lens_stack((Plane(), Cylinder(-16.54)), 4.0)
    k = float(v / np.sqrt(1.0 + u**2 + v**2))
    found = float(effective_index(INDEX, np.array([u]), np.array([v]))[0])
    assert in_plane_stack(stack, k).surfaces[0].index_behind == pytest.approx(found, rel=1e-13)
    assert found >= INDEX


def test_what_is_refused() -> None:
    with pytest.raises(InvalidParameter, match="surface 1 is Conic"):
        in_plane_stack(lens_stack((Plane(), Conic(-16.54)), 4.0), 0.1)
    with pytest.raises(InvalidParameter, match=r"direction_y is 1\.0"):
        in_plane_stack(lens_stack((Plane(), Cylinder(-16.54)), 4.0), 1.0)
    tilted = Surface(Cylinder(20.0), rotation_vector_rad=(0.1, 0.0, 0.0), index_behind=1.5)
    stack = SurfaceStack((tilted,), Surface(Plane(), (0.0, 0.0, 30.0)))
    with pytest.raises(InvalidParameter, match="turned about y only"):
        in_plane_stack(stack, 0.1)
