"""MappingSettings, and MappingResult: a correction table with its settings and validation."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from compute.camera.model import Vector3
from compute.errors import InvalidParameter
from compute.mapping.table import CorrectionTable

MappingMethod = Literal["b-spline", "trilinear", "tricubic"]


@dataclass(frozen=True)
class MappingSettings:
    """Settings of building a correction table from mapping measurements.

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
        for name, reason, positive in (
            (
                "pitch_mm",
                f'with the method "{self.method}" the grid is that of the points, leave it out',
                self.pitch_mm is None or all(0.0 < value < np.inf for value in self.pitch_mm),
            ),
            (
                "penalty_weight",
                f'the method "{self.method}" goes through every value and has none, leave it out',
                self.penalty_weight is None or 0.0 < self.penalty_weight < np.inf,
            ),
        ):
            value = getattr(self, name)
            if not positive:
                raise InvalidParameter(f"{name} is {value}; it must be positive")
            if value is not None and self.method != "b-spline":
                raise InvalidParameter(f"{name} is {value}; {reason}")
        if self.min_neighbours < 1:
            raise InvalidParameter(f"min_neighbours is {self.min_neighbours}; it must be 1 or more")


@dataclass(frozen=True)
class Suspect:
    """A measurement that contradicts its neighbours.

    Args:
        point: its index, from 0.
        left_out_px: its prediction error with its block left out [px].
        normalised_error: the same over its expected standard deviation.
    """

    point: int
    left_out_px: float
    normalised_error: float


@dataclass(frozen=True)
class Hole:
    """The largest ball without measurements where the table is not valid.

    Args:
        centre_mm: its centre [mm].
        diameter_mm: its diameter [mm].
    """

    centre_mm: Vector3
    diameter_mm: float


@dataclass(frozen=True)
class SensorMapping:
    """Mapping of one sensor; None for values that interpolation does not give.

    Args:
        sensor: its name.
        points: number of measurements that it saw.
        before_rms_px: RMS of projection minus measurement without the table [px].
        after_rms_px: the same with the table, at the measurements themselves [px].
        left_out_rms_px: the same for left-out blocks of measurements [px].
        normalised_squared_error: mean square of the left-out errors over their expected variance; 1
            if the table's variances are right.
        effective_parameters: effective number of parameters, the calibration's included.
        penalty_weight: weight of the penalty [1/px^2], on squared differences of the splines'
            coefficients.
        axis_weights: relative weights of the differences along x, y and z.
        gcv_ratio: RMS error by generalised cross-validation over that by blocks: far below 1 where
            neighbouring measurements have correlated errors.
        sigma_px: standard deviation of a reading (root of the mean square), given or estimated.
        noise_factor: factor of the given variances because the residuals are larger than they
            explain; 1 where they are not.
        valid_share: share of the grid's cells that measurements support.
        resolution_mm: full width at half maximum of the narrowest features that are mapped within
            the stated deviations: two diameters of the largest gap between measurements within the
            valid cells [mm].
        largest_hole: largest region within the measurements' hull that has none, and is not valid.
        coverage: the last three in words.
        suspects: measurements more than five standard deviations off, the worst first.
    """

    sensor: str
    points: int
    before_rms_px: float
    after_rms_px: float
    left_out_rms_px: float | None
    normalised_squared_error: float | None
    effective_parameters: float | None
    penalty_weight: float | None
    axis_weights: Vector3 | None
    gcv_ratio: float | None
    sigma_px: float
    noise_factor: float
    valid_share: float
    resolution_mm: float | None
    largest_hole: Hole | None
    coverage: str
    suspects: tuple[Suspect, ...] = ()


def describe_coverage(
    valid_share: float, resolution_mm: float | None = None, hole: Hole | None = None
) -> str:
    """Return what part of the volume a table supports, in words.

    Args:
        valid_share: share of the grid's cells that measurements support.
        resolution_mm: width of the narrowest features that are resolved [mm]; None: not known.
        hole: the largest hole; None: there is none.
    """
    message = f"measurements support {100.0 * valid_share:.0f} % of the volume"
    if resolution_mm is not None:
        message += f"; features narrower than {resolution_mm:.3g} mm may be missed"
    if hole is not None:
        place = ", ".join(f"{value:.0f}" for value in hole.centre_mm)
        message += (
            f"; not valid is a hole of {hole.diameter_mm:.3g} mm around ({place}) mm: add points "
            "there"
        )
    return message


@dataclass(frozen=True)
class MappingValidation:
    """Validation of a table by the measurements that it was built from.

    Args:
        spacing_mm: mean distance between neighbouring measurements [mm].
        pitch_mm: edges of the cells [mm].
        sensors: one for each, in the calibration's order.
    """

    spacing_mm: float
    pitch_mm: Vector3
    sensors: tuple[SensorMapping, ...]


@dataclass(frozen=True, eq=False)
class MappingResult:
    """A correction table with its settings and validation.

    Args:
        table: the corrections.
        settings: the mapping settings.
        validation: errors estimated from the measurements.
    """

    table: CorrectionTable
    settings: MappingSettings
    validation: MappingValidation
