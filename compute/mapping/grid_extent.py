"""The grid of a map: over the box of its measurements, by a pitch or by their spacing."""

from typing import Final

import numpy as np
from scipy.spatial import ConvexHull

from compute.camera.model import vector3
from compute.errors import InvalidParameter
from compute.mapping.grid import VoxelGrid
from compute.mapping.measurements import MappingMeasurements
from compute.mapping.settings import MappingSettings

MAX_CELLS: Final = 200_000
MAX_ALONG: Final = 256
"""Cells of a grid, and of one of its axes."""


def point_spacing(measured: MappingMeasurements) -> float:
    """Return the distance between neighbours, were the points spread evenly [mm]."""
    volume = float(ConvexHull(measured.points_mm).volume)
    return float(np.cbrt(volume / len(measured.points_mm)))


def grid_for_points(
    measured: MappingMeasurements, spacing: float, settings: MappingSettings
) -> VoxelGrid:
    """Return the grid over the box of the points.

    Args:
        measured: the points.
        spacing: their distance, the pitch where none is asked for [mm].
        settings: what is asked for.

    Raises:
        InvalidParameter: the pitch makes more cells than can be held.
    """
    low, high = measured.points_mm.min(axis=0), measured.points_mm.max(axis=0)
    given = settings.pitch_mm
    wanted = np.full(3, spacing) if given is None else np.asarray(given)
    with np.errstate(over="ignore"):  # of a pitch of next to nothing: refused below
        counts = np.maximum((high - low) / wanted, 1.0)
    counts = np.rint(counts) if given is None else np.ceil(counts - 1e-9)
    if given is None:
        # Points very near to one another in few places: no more cells than can be held.
        counts = np.minimum(counts, MAX_ALONG)
    if counts.max() > MAX_ALONG or counts.prod() > MAX_CELLS:
        raise InvalidParameter(
            f"pitch_mm {given} makes {'x'.join(f'{count:.0f}' for count in counts)} cells of the "
            f"measured volume of {'x'.join(f'{side:.4g}' for side in high - low)} mm; at most "
            f"{MAX_CELLS} and {MAX_ALONG} along an axis are held, take a larger one"
        )
    pitch = (high - low) / counts if given is None else wanted
    origin = 0.5 * (low + high) - 0.5 * pitch * counts
    x, y, z = (int(count) for count in counts)
    return VoxelGrid(vector3(origin), vector3(pitch), (x, y, z))
