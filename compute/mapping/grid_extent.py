"""Voxel grid of a map over the box of its measurements."""

from typing import Final

import numpy as np
from scipy.spatial import ConvexHull

from compute.camera.model import vector3
from compute.errors import InvalidParameter
from compute.mapping.grid import VoxelGrid
from compute.mapping.measurements import MappingMeasurements
from compute.mapping.settings import MappingSettings

MAX_CELLS: Final = 200_000
"""Largest number of cells of a grid."""
MAX_ALONG: Final = 256
"""Largest number of cells along an axis."""


def point_spacing(measured: MappingMeasurements) -> float:
    """Return the mean distance between neighbouring points, as if evenly spread [mm]."""
    volume = float(ConvexHull(measured.points_mm).volume)
    return float(np.cbrt(volume / len(measured.points_mm)))


def grid_for_points(
    measured: MappingMeasurements, spacing: float, settings: MappingSettings
) -> VoxelGrid:
    """Return the grid over the box of the measurements.

    Args:
        measured: the measurements.
        spacing: mean distance between neighbours, the pitch if the settings have none [mm].
        settings: the mapping settings.

    Raises:
        InvalidParameter: the pitch makes too many cells.
    """
    low, high = measured.points_mm.min(axis=0), measured.points_mm.max(axis=0)
    requested = settings.pitch_mm
    wanted = np.full(3, spacing) if requested is None else np.asarray(requested)
    with np.errstate(over="ignore"):  # a tiny pitch: refused below
        counts = np.maximum((high - low) / wanted, 1.0)
    counts = np.rint(counts) if requested is None else np.ceil(counts - 1e-9)
    if requested is None:
        # Clustered points: no more cells than the limit.
        counts = np.minimum(counts, MAX_ALONG)
    if counts.max() > MAX_ALONG or counts.prod() > MAX_CELLS:
        raise InvalidParameter(
            f"pitch_mm {requested} makes {'x'.join(f'{count:.0f}' for count in counts)} cells of "
            f"the measured volume of {'x'.join(f'{side:.4g}' for side in high - low)} mm; at most "
            f"{MAX_CELLS} and {MAX_ALONG} along an axis are held, take a larger one"
        )
    pitch = (high - low) / counts if requested is None else wanted
    origin = 0.5 * (low + high) - 0.5 * pitch * counts
    x, y, z = (int(count) for count in counts)
    return VoxelGrid(vector3(origin), vector3(pitch), (x, y, z))
