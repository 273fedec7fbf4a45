"""Stacks that several tests look through."""

import numpy as np

from compute.optics.tracing.surfaces import Conic, Cylinder, Plane, Shape, Surface, SurfaceStack

INDEX = 1.52
SPHERES: dict[str, tuple[tuple[Shape, Shape], float]] = {
    "plano-convex": ((Plane(), Conic(-16.54)), 4.0),
    "convex-plano": ((Conic(16.54), Plane()), 4.0),
    "biconvex": ((Conic(30.0), Conic(-40.0)), 5.0),
    "biconvex, figured": ((Conic(30.0, -0.7), Conic(-40.0, 0.5)), 5.0),
    "biconcave": ((Conic(-45.0), Conic(60.0)), 2.0),
}


def lens_stack(
    shapes: tuple[Shape, Shape], thickness_mm: float, stop_z_mm: float | None = None
) -> SurfaceStack:
    """A lens with its front at z = 0, and a stop before or behind it."""
    lens = [
        Surface(shapes[0], index_behind=INDEX),
        Surface(shapes[1], (0.0, 0.0, thickness_mm)),
    ]
    stop = [] if stop_z_mm is None else [Surface(Plane(), (0.0, 0.0, stop_z_mm))]
    before = stop_z_mm is not None and stop_z_mm <= 0.0
    surfaces = (*stop, *lens) if before else (*lens, *stop)
    return SurfaceStack(tuple(surfaces), Surface(Plane(), (0.0, 0.0, thickness_mm + 35.0)))


def cylindrical(shapes: tuple[Shape, Shape]) -> tuple[Shape, Shape]:
    """The same profiles along x only."""
    made = [
        Cylinder(shape.radius_mm, shape.conic) if isinstance(shape, Conic) else shape
        for shape in shapes
    ]
    return made[0], made[1]


def relative(found: float, wanted: float) -> float:
    return float(np.abs(found - wanted) / np.abs(wanted))
