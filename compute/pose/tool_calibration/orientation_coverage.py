"""OrientationCoverage: how far, and about which of its axes, a tool was turned."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from compute.camera.rotation import rotation_vector

Array = NDArray[np.float64]

_PAIRS = 400


@dataclass(frozen=True, eq=False)
class OrientationCoverage:
    """How a tool's orientations are spread.

    A direction u of the tool points along R_i u. With M the mean of the R_i, the variance of
    these is ``1 - |M u|^2``: the sine squared of the RMS angle by which the direction swung. The
    singular vectors of M are the directions that swung least and most. Turns about one axis only
    leave that axis where it was.

    Args:
        axes: three perpendicular directions in the tool, the one that swung least first; a row
            each, shape (3, 3).
        swing_rad: RMS angle by which each swung about its mean, shape (3,) [rad].
        range_rad: the largest angle between two orientations [rad] (of at most 400, evenly
            chosen).
    """

    axes: Array
    swing_rad: Array
    range_rad: float

    @classmethod
    def of(cls, rotations: Array) -> Self:
        """Return how N orientations (N, 3, 3), R_world_tool, are spread."""
        _, values, axes = np.linalg.svd(rotations.mean(axis=0))
        sine = np.sqrt(np.clip(1.0 - values**2, 0.0, 1.0))
        some = rotations[np.unique(np.linspace(0, len(rotations) - 1, _PAIRS).astype(int))]
        # trace(R_i' R_j) falls with the angle.
        flat = some.reshape(len(some), 9)
        first, second = np.unravel_index(np.argmin(flat @ flat.T), (len(some), len(some)))
        angle = np.linalg.norm(rotation_vector(some[first] @ some[second].T))
        return cls(axes, np.arcsin(sine), float(angle))

    def describe(self) -> str:
        """Return the angles by axis, for a message."""
        parts = [
            f"{np.degrees(swing):.1f} deg along ({axis[0]:.2f}, {axis[1]:.2f}, {axis[2]:.2f})"
            for axis, swing in zip(self.axes, self.swing_rad, strict=True)
        ]
        return (
            f"the tool's directions swung by {', '.join(parts)} (RMS, in the tool's coordinates); "
            f"the orientations span {np.degrees(self.range_rad):.1f} deg"
        )
