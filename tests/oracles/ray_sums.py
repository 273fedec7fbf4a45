"""Light of a point on a row of pixels, as a plain sum of rays over the whole first opening.

No ray is aimed and no edge is searched: a ray counts if it ends within the row's height. What is
shared with the code under test is the tracing of single rays, which has tests of its own.
"""

from typing import Any

import numpy as np

from compute.optics.tracing.assembly import Assembly
from compute.optics.tracing.reference_tracer import RayStatus, trace_rays


def row_solid_angle_sr(
    assembly: Assembly,
    seen_mm: Any,
    opening_mm: tuple[float, float],
    row_height_mm: float,
    rays: tuple[int, int] = (41, 4001),
) -> float:
    """Return the effective solid angle of the light that meets a row of unlimited length [sr].

    The sum is right to about the inverse of the rays along y that meet the row, some thirty.

    Args:
        assembly: the optics.
        seen_mm: the point in the sensor's frame, z towards the object, shape (3,) [mm].
        opening_mm: width and height of the first opening, which is centred [mm].
        row_height_mm: height of the pixels [mm].
        rays: rays along x and along y.
    """
    source = np.asarray(seen_mm) * [1.0, -1.0, -1.0]
    width, height = opening_mm
    x = ((np.arange(rays[0]) + 0.5) / rays[0] - 0.5) * width
    y = ((np.arange(rays[1]) + 0.5) / rays[1] - 0.5) * height
    across, along = (values.ravel() for values in np.meshgrid(x, y, indexing="ij"))
    depth = np.full(across.shape, assembly.front_z_mm - source[2])
    towards = np.stack([across - source[0], along - source[1], depth], axis=1)
    traced = trace_rays(assembly.stack(), np.tile(source, (len(towards), 1)), towards)
    meets = (traced.status == RayStatus.ARRIVED) & (
        np.abs(traced.position_mm[:, 1]) <= row_height_mm / 2.0
    )
    cell_mm2 = width / rays[0] * height / rays[1]
    solid = np.abs(depth) / (towards**2).sum(axis=1) ** 1.5 * cell_mm2
    return float((solid * traced.transmittance.mean(axis=1))[meets].sum())
