"""RigidBody: where the markers of a tool are, in the tool's own coordinates."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.camera.model import Vector3

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class RigidBody:
    """A tool's markers, tip and name.

    Args:
        name: unique among the tools of a device; letters, digits, "_" and "-".
        markers_mm: M markers in the tool's coordinates, shape (M, 3) [mm].
        strobe_markers: number of each marker's strobe slot or blinking code, M of them, all
            different; None: the markers are lit together and told by their geometry.
        tip_mm: the working point in the tool's coordinates [mm]; None: its origin.
        max_tip_sd_mm: 3D standard deviation of the tip above which a pose is HIGH_ERROR [mm];
            None: the tracker's settings say.
    """

    name: str
    markers_mm: Array
    strobe_markers: tuple[int, ...] | None = None
    tip_mm: Vector3 | None = None
    max_tip_sd_mm: float | None = None

    def __len__(self) -> int:
        """Return the number of markers."""
        return len(self.markers_mm)
