"""MarkerFrame: a tool's markers about their centroid, where turns and shifts are least coupled."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from compute.pose.rigid_body import RigidBody
from compute.pose.small import one_cross

Array = NDArray[np.float64]

_SAME = np.eye(3)
COLLINEAR_SHARE = 1e-3
"""Points whose spread across their line is a smaller share of that along it are on a line."""


@dataclass(frozen=True, eq=False)
class MarkerFrame:
    """The tool's coordinates moved to the centroid of its markers.

    A turn at the tool's origin, which may lie a metre from its markers, moves them all; at the
    centroid a turn and a shift are told apart best. Fits and filters work there.

    Args:
        centroid_mm: in the tool's own coordinates, shape (3,) [mm].
        markers_mm: less the centroid, shape (M, 3) [mm].
        radius_mm: RMS distance of the markers from the centroid [mm]: turns times this are mm.
        tip_mm: the tip less the centroid, shape (3,) [mm].
        collinear: whether the markers are on a line.
    """

    centroid_mm: Array
    markers_mm: Array
    radius_mm: float
    tip_mm: Array
    collinear: bool

    @classmethod
    def of(cls, tool: RigidBody) -> "MarkerFrame":
        """Return the frame of a tool's markers; tools do not change, so it is kept."""
        return _frame_of(tool)

    def translation(self, rotation: Array, centroid_mm: Array) -> Array:
        """Return the tool's origin in the world, of the centroid in the world."""
        origin: Array = centroid_mm - rotation @ self.centroid_mm
        return origin

    def centroid(self, rotation: Array, translation_mm: Array) -> Array:
        """Return the centroid in the world, of the tool's origin in the world."""
        place: Array = translation_mm + rotation @ self.centroid_mm
        return place

    def origin_slopes(self, rotation: Array) -> Array:
        """Return d (turn, origin) / d (turn, centroid), shape (6, 6)."""
        slopes = np.eye(6)
        # A turn w moves the origin, which is at -R c from the centroid, by w x (-R c).
        slopes[3:, :3] = one_cross(rotation @ self.centroid_mm)
        return slopes

    def tip_slopes(self, rotation: Array) -> Array:
        """Return d tip / d (turn, centroid), shape (3, 6)."""
        slopes = np.empty((3, 6))
        slopes[:, :3] = -one_cross(rotation @ self.tip_mm)
        slopes[:, 3:] = _SAME
        return slopes


@lru_cache(maxsize=256)
def _frame_of(tool: RigidBody) -> MarkerFrame:
    markers = np.asarray(tool.markers_mm, dtype=np.float64)
    centroid = markers.mean(axis=0)
    about = markers - centroid
    tip = np.zeros(3) if tool.tip_mm is None else np.array(tool.tip_mm)
    radius = float(np.sqrt((about**2).sum(axis=1).mean()))
    return MarkerFrame(centroid, about, radius, tip - centroid, is_line(markers))


def is_line(points_mm: Array) -> bool:
    """Return whether points (N, 3) are on a line, or are fewer than three."""
    if len(points_mm) < 3:
        return True
    spread = np.linalg.svd(points_mm - points_mm.mean(axis=0), compute_uv=False)
    return bool(spread[1] <= COLLINEAR_SHARE * spread[0])
