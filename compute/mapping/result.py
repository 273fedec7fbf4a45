"""MappingResult: a correction table, how it was built, and what is known of its errors."""

from dataclasses import dataclass

from compute.camera.model import Vector3
from compute.mapping.settings import MappingSettings
from compute.mapping.table import CorrectionTable


@dataclass(frozen=True)
class Suspect:
    """A measurement that its neighbours contradict.

    Args:
        point: its number, counted from 0.
        left_out_px: its error where its block was left out [px].
        normalised_error: the same in the standard deviations that it should have.
    """

    point: int
    left_out_px: float
    normalised_error: float


@dataclass(frozen=True)
class SensorMapping:
    """What the mapping of one sensor says; what interpolation cannot know is None.

    Args:
        sensor: its name.
        points: measurements that it saw.
        before_rms_px: projection less measurement, without the table [px].
        after_rms_px: the same with it, at the measurements themselves [px].
        left_out_rms_px: at blocks of measurements that were left out, without their own [px].
        normalised_squared_error: mean square of the left-out errors over what they should have: 1 where
            the table's variances are honest.
        effective_parameters: how many parameters the fit amounts to, the calibration's included.
        penalty_weight: weight of the penalty [1/px^2], on the squared differences of the splines'
            coefficients.
        axis_weights: of the differences along x, y and z.
        gcv_ratio: the generalised cross-validation's error over that of the blocks, RMS: far below
            1 where neighbouring measurements share errors that are not the field's.
        sigma_px: standard deviation of a reading (root of the mean square), given or estimated.
        noise_factor: by what the given variances are multiplied, because the residuals are
            larger than they explain; 1 where they are not.
        valid_share: share of the grid's cells that the table vouches for.
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
    suspects: tuple[Suspect, ...] = ()


@dataclass(frozen=True)
class MappingValidation:
    """What is known of a table's errors from the measurements that it was built from.

    Args:
        spacing_mm: distance between neighbouring measurements [mm].
        pitch_mm: edges of the cells [mm].
        sensors: by sensor, in the calibration's order.
    """

    spacing_mm: float
    pitch_mm: Vector3
    sensors: tuple[SensorMapping, ...]


@dataclass(frozen=True, eq=False)
class MappingResult:
    """A table with its provenance.

    Args:
        table: the corrections.
        settings: how it was built.
        validation: what is known of its errors.
    """

    table: CorrectionTable
    settings: MappingSettings
    validation: MappingValidation
