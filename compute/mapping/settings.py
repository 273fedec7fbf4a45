"""MappingSettings: how a correction table is built."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from compute.camera.model import Vector3
from compute.errors import InvalidParameter

MappingMethod = Literal["b-spline", "trilinear", "tricubic"]


@dataclass(frozen=True)
class MappingSettings:
    """How a correction table is built from mapping measurements.

    Args:
        method: "b-spline", a penalised tensor B-spline of degree 3, for points anywhere; or
            "trilinear" and "tricubic", which go through every measured value and need points on
            a grid.
        pitch_mm: edges of the cells [mm]; None: about the distance between neighbouring points.
            For "trilinear" and "tricubic" the grid is that of the points, and this is None.
        penalty_weight: weight of the penalty, in the units of ``SensorMapping.penalty_weight``;
            None: chosen by cross-validation over blocks, by sensor.
        min_neighbours: smallest number of measurements near a cell that support it.

    Raises:
        InvalidParameter: a value that is none of that.
    """

    method: MappingMethod = "b-spline"
    pitch_mm: Vector3 | None = None
    penalty_weight: float | None = None
    min_neighbours: int = 4

    def __post_init__(self) -> None:
        if self.method not in ("b-spline", "trilinear", "tricubic"):
            raise InvalidParameter(
                f'method is "{self.method}"; it must be "b-spline", "trilinear" or "tricubic"'
            )
        if self.pitch_mm is not None:
            if not all(0.0 < value < np.inf for value in self.pitch_mm):
                raise InvalidParameter(f"pitch_mm is {self.pitch_mm}; it must be positive")
            if self.method != "b-spline":
                raise InvalidParameter(
                    f'pitch_mm is {self.pitch_mm}; with the method "{self.method}" the grid is '
                    "that of the points, leave it out"
                )
        if self.penalty_weight is not None:
            if not 0.0 < self.penalty_weight < np.inf:
                raise InvalidParameter(
                    f"penalty_weight is {self.penalty_weight}; it must be positive"
                )
            if self.method != "b-spline":
                raise InvalidParameter(
                    f'penalty_weight is {self.penalty_weight}; the method "{self.method}" goes '
                    "through every value and has none, leave it out"
                )
        if self.min_neighbours < 1:
            raise InvalidParameter(f"min_neighbours is {self.min_neighbours}; it must be 1 or more")
