"""Peer of the ray tracing benchmark: the same surfaces in optiland."""

from collections.abc import Callable
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from compute.optics.tracing import surfaces

# Its annotations are not complete: to the type checker it is anything.
coordinates: Any = import_module("optiland.coordinate_system")
geometries: Any = import_module("optiland.geometries")
materials: Any = import_module("optiland.materials")
rays: Any = import_module("optiland.rays")
theirs: Any = import_module("optiland.surfaces")

Array = NDArray[np.float64]
Tracer = Callable[[Array, Array], tuple[Array, Array, Array]]

TOLERANCE_MM = 1e-13
"""Of optiland's Newton method, for its biconic and toroidal surfaces; its own is 1e-10."""
WAVELENGTH_UM = 0.587
"""Nothing depends on it: the indices are given."""


def optiland_tracer(stack: surfaces.SurfaceStack, tolerance_mm: float = TOLERANCE_MM) -> Tracer:
    """Return a function that traces origins and unit directions, (N, 3), through a stack.

    It returns positions and directions in the image plane's frame, (N, 3), and optical paths,
    (N,). Openings are left out: optiland lets rays outside of them go on.
    """
    before = theirs.ObjectSurface(
        geometries.Plane(coordinates.CoordinateSystem()),
        materials.IdealMaterial(stack.index_in_front),
    )
    chain: list[Any] = []
    for surface in stack.surfaces:
        before = theirs.Surface(
            before, materials.IdealMaterial(surface.index_behind), _geometry(surface, tolerance_mm)
        )
        chain.append(before)
    end = _geometry(stack.image, tolerance_mm)
    chain.append(theirs.Surface(before, before.material_post, end))

    def trace(origins_mm: Array, directions: Array) -> tuple[Array, Array, Array]:
        ones = np.ones(len(origins_mm))
        # Copies: optiland moves rays in place.
        columns = [column.copy() for column in (*origins_mm.T, *directions.T)]
        bundle = rays.RealRays(*columns, ones, ones * WAVELENGTH_UM)
        for surface in chain:
            surface.trace(bundle, record=False)
        end.localize(bundle)
        return (
            np.column_stack([bundle.x, bundle.y, bundle.z]),
            np.column_stack([bundle.L, bundle.M, bundle.N]),
            bundle.opd,
        )

    return trace


def _geometry(surface: surfaces.Surface, tolerance_mm: float) -> Any:
    shape = surface.shape
    turn = Rotation.from_rotvec(surface.rotation_vector_rad)
    if isinstance(shape, surfaces.Toroid):
        # Theirs has its profile in the y-z plane.
        turn = turn * Rotation.from_euler("z", -90.0, degrees=True)
    position = coordinates.CoordinateSystem(*surface.vertex_mm, *turn.as_euler("xyz"))
    if isinstance(shape, surfaces.Plane):
        return geometries.Plane(position)
    if isinstance(shape, surfaces.Conic):
        return geometries.StandardGeometry(position, shape.radius_mm, shape.conic)
    if isinstance(shape, surfaces.Cylinder):
        curved = geometries.BiconicGeometry(
            position, shape.radius_mm, np.inf, shape.conic, 0.0, tol=tolerance_mm
        )
    else:
        curved = geometries.ToroidalGeometry(
            position, shape.radius_y_mm, shape.radius_x_mm, shape.conic, tol=tolerance_mm
        )
    # Newton's method starts at a sphere of this radius, which rays to the upper part of a cylinder
    # do not meet: they would be lost. It starts at the tangent plane instead.
    curved.radius = np.inf
    return curved
