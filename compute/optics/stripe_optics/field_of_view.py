"""Part of a sensor's field of view that is tabulated, and the number of nodes."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter

Array = NDArray[np.float64]

DEGREE: Final = 3
"""Degree of the splines between the nodes."""


@dataclass(frozen=True)
class FieldOfView:
    """Tabulated part of a sensor's field of view, in its frame.

    Args:
        u: least and largest x/z, along the row.
        v: least and largest y/z, along the lens's axis.
        distance_mm: least and largest z [mm], positive.

    Raises:
        InvalidParameter: an interval that is empty or not finite, a distance not positive.
    """

    u: tuple[float, float]
    v: tuple[float, float]
    distance_mm: tuple[float, float]

    def __post_init__(self) -> None:
        for name in ("u", "v", "distance_mm"):
            low, high = getattr(self, name)
            if not (np.isfinite([low, high]).all() and low < high):
                raise InvalidParameter(
                    f"{name} is {low} to {high}; it must be a finite interval",
                    **{name: (low, high)},
                )
        if self.distance_mm[0] <= 0.0:
            raise InvalidParameter(
                f"distance_mm begins at {self.distance_mm[0]}; it must be positive",
                distance_mm=self.distance_mm,
            )

    def contains(self, points_mm: Array) -> NDArray[np.bool_]:
        """Return which points (N, 3) of the sensor's frame [mm] lie in it, shape (N,)."""
        z = points_mm[:, 2]
        inside = (z >= self.distance_mm[0]) & (z <= self.distance_mm[1])
        for (low, high), along in ((self.u, points_mm[:, 0]), (self.v, points_mm[:, 1])):
            inside &= (along >= low * z) & (along <= high * z)
        return inside


@dataclass(frozen=True)
class TableNodes:
    """Numbers of nodes of a table, at least 7 along u and 4 along the other axes.

    Args:
        u: along u, from end to end.
        v: along v from the middle to the end, in steps of v^2 where the optics are symmetric.
        distance: along the inverse distance.
    """

    u: int = 49
    v: int = 85
    distance: int = 9

    def __post_init__(self) -> None:
        for name in ("u", "v", "distance"):
            value = getattr(self, name)
            least = 2 * DEGREE + 1 if name == "u" else DEGREE + 1  # half of u may be tabulated
            if value < least:
                raise InvalidParameter(
                    f"{name} is {value} nodes; it must be at least {least}", **{name: value}
                )
