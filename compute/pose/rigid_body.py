"""RigidBody: marker coordinates of a tool; CentredMarkers: the same about their centroid."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from compute.camera.model import Vector3
from compute.camera.rotation import hat_so3

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class RigidBody:
    """A tool's markers, tip and name.

    Args:
        name: unique among the tools of a device; letters, digits, "_" and "-".
        markers_mm: M markers in the tool's coordinates, shape (M, 3) [mm].
        strobe_markers: number of each marker's strobe slot or blinking code, M of them, all
            different; None: the markers are lit together and identified by their geometry.
        tip_mm: the tip in the tool's coordinates [mm]; None: its origin.
        max_tip_sd_mm: 3D standard deviation of the tip above which a pose is HIGH_ERROR [mm];
            None: that of the tracker's settings.
    """

    name: str
    markers_mm: Array
    strobe_markers: tuple[int, ...] | None = None
    tip_mm: Vector3 | None = None
    max_tip_sd_mm: float | None = None

    def __len__(self) -> int:
        """Return the number of markers."""
        return len(self.markers_mm)


_IDENTITY = np.eye(3)
COLLINEARITY_RATIO = 1e-3
"""Points whose spread across their line is below this fraction of that along it are collinear."""


@dataclass(frozen=True, eq=False)
class CentredMarkers:
    """A tool's coordinates relative to the centroid of its markers.

    The tool's origin may be a metre from its markers, where a rotation moves them all. About the
    centroid, rotation and translation are least correlated, so fits and filters work there.

    Args:
        centroid_mm: centroid in the tool's coordinates, shape (3,) [mm].
        markers_mm: markers less the centroid, shape (M, 3) [mm].
        radius_mm: RMS distance of the markers from the centroid [mm]; it converts rad to mm.
        tip_mm: tip less the centroid, shape (3,) [mm].
        collinear: whether the markers are on a line.
    """

    centroid_mm: Array
    markers_mm: Array
    radius_mm: float
    tip_mm: Array
    collinear: bool

    @classmethod
    def of(cls, tool: RigidBody) -> "CentredMarkers":
        """Return the centred markers of a tool; they are cached, as tools do not change."""
        return _centre(tool)

    def translation(self, rotation: Array, centroid_mm: Array) -> Array:
        """Return the tool's origin in the world, shape (3,) [mm].

        Args:
            rotation: R_world_tool, shape (3, 3).
            centroid_mm: centroid of the markers in the world, shape (3,) [mm].
        """
        origin: Array = centroid_mm - rotation @ self.centroid_mm
        return origin

    def centroid(self, rotation: Array, translation_mm: Array) -> Array:
        """Return the centroid of the markers in the world, shape (3,) [mm].

        Args:
            rotation: R_world_tool, shape (3, 3).
            translation_mm: the tool's origin in the world, shape (3,) [mm].
        """
        place: Array = translation_mm + rotation @ self.centroid_mm
        return place

    def origin_jacobian(self, rotation: Array) -> Array:
        """Return d (rotation, origin) / d (rotation, centroid), shape (6, 6)."""
        jacobian = np.eye(6)
        # A rotation w moves the origin, which is at -R c from the centroid, by w x (-R c).
        jacobian[3:, :3] = hat_so3(rotation @ self.centroid_mm)
        return jacobian

    def tip_jacobian(self, rotation: Array) -> Array:
        """Return d tip / d (rotation, centroid), shape (3, 6)."""
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
