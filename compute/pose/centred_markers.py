"""CentredMarkers: a tool's markers relative to their centroid."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from compute.pose.rigid_body import RigidBody
from compute.pose.so3 import hat_so3

Array = NDArray[np.float64]

_IDENTITY = np.eye(3)
COLLINEARITY_RATIO = 1e-3
"""Points whose spread across their line is a smaller share of that along it are on a line."""


@dataclass(frozen=True, eq=False)
class CentredMarkers:
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
    def of(cls, tool: RigidBody) -> "CentredMarkers":
        """Return the frame of a tool's markers; tools do not change, so it is kept."""
        return _centre(tool)

    def translation(self, rotation: Array, centroid_mm: Array) -> Array:
        """Return the tool's origin in the world, of the centroid in the world."""
        origin: Array = centroid_mm - rotation @ self.centroid_mm
        return origin

    def centroid(self, rotation: Array, translation_mm: Array) -> Array:
        """Return the centroid in the world, of the tool's origin in the world."""
        place: Array = translation_mm + rotation @ self.centroid_mm
        return place

    def origin_jacobian(self, rotation: Array) -> Array:
        """Return d (turn, origin) / d (turn, centroid), shape (6, 6)."""
        jacobian = np.eye(6)
        # A turn w moves the origin, which is at -R c from the centroid, by w x (-R c).
        jacobian[3:, :3] = hat_so3(rotation @ self.centroid_mm)
        return jacobian

    def tip_jacobian(self, rotation: Array) -> Array:
        """Return d tip / d (turn, centroid), shape (3, 6)."""
        jacobian = np.empty((3, 6))
        jacobian[:, :3] = -hat_so3(rotation @ self.tip_mm)
        jacobian[:, 3:] = _IDENTITY
        return jacobian


@lru_cache(maxsize=256)
def _centre(tool: RigidBody) -> CentredMarkers:
    markers = np.asarray(tool.markers_mm, dtype=np.float64)
    centroid = markers.mean(axis=0)
    about = markers - centroid
    tip = np.zeros(3) if tool.tip_mm is None else np.array(tool.tip_mm)
    radius = float(np.sqrt((about**2).sum(axis=1).mean()))
    return CentredMarkers(centroid, about, radius, tip - centroid, are_collinear(markers))


def are_collinear(points_mm: Array) -> bool:
    """Return whether points (N, 3) are on a line, or are fewer than three."""
    if len(points_mm) < 3:
        return True
    spread = np.linalg.svd(points_mm - points_mm.mean(axis=0), compute_uv=False)
    return bool(spread[1] <= COLLINEARITY_RATIO * spread[0])
