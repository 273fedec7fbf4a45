"""ActiveCalibration: what a device reconstructs with; PreparedCalibration: the same, for frames."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import datetime
from functools import cached_property
from typing import Any, Final, Literal, Self, get_args

import numpy as np
from numpy.typing import NDArray

from compute.calibration.result import Calibration, measurement_noise
from compute.errors import InvalidParameter
from compute.mapping.table import CorrectionTable
from compute.measurement.measurement_model import MeasurementModel
from compute.measurement.measurements import MeasurementNoise
from compute.reconstruction.solver import PointSolver
from compute.signal.radiometric_calibration import BadPixel, RadiometricCalibration

Array = NDArray[np.float64]

LiveKind = Literal["hot", "stuck", "dead"]

KINDS: Final[Mapping[BadPixel, LiveKind]] = {
    BadPixel[one.upper()]: one for one in get_args(LiveKind)
}


@dataclass(frozen=True)
class LiveBadPixel:
    """A pixel that a device's frames have shown to be bad since it was started; it is masked.

    Args:
        sensor: its name.
        pixel: number of the pixel.
        kind: hot (far above its neighbours in all frames), stuck (its count never changes), or dead
            (light passed over its neighbours, and it did not see it).
        found_at: exposure of the frame with which it was found.
    """

    sensor: str
    pixel: int
    kind: LiveKind
    found_at: datetime


def bad_pixel_flags(
    bad_pixels: Iterable[LiveBadPixel], sensor: str, pixels: int
) -> NDArray[np.uint8]:
    """Return BadPixel flags of a sensor, uint8, shape (P,).

    Args:
        bad_pixels: bad pixels of a device.
        sensor: the sensor's name.
        pixels: P.

    Raises:
        InvalidParameter: the sensor has no such pixel.
    """
    flags = np.zeros(pixels, np.uint8)
    for one in bad_pixels:
        if one.sensor == sensor:
            if not 0 <= one.pixel < pixels:
                raise InvalidParameter(
                    f"the bad pixel {one.pixel} is of a sensor {sensor} that has {pixels} pixels"
                )
            flags[one.pixel] |= np.uint8(BadPixel[one.kind.upper()])
    return flags


@dataclass(frozen=True, eq=False)
class ActiveRadiometric:
    """The radiometric calibration that a device uses.

    Args:
        radiometric_id: its id.
        sensors: the calibration of each sensor that has one, by name.
        content_hash: hash of ``content``.
        content: as it is stored, for recordings.
    """

    radiometric_id: str
    sensors: Mapping[str, RadiometricCalibration]
    content_hash: str
    content: Mapping[str, Any]


@dataclass(frozen=True, eq=False)
class ActiveCalibration:
    """The calibration and the correction table that the pointer of a device names.

    Args:
        calibration_id: the calibration's id; None: none, there are peaks only.
        calibration: the calibration.
        table_id: the correction table's id; None: readings are not corrected.
        table: the table.
        calibration_content: the calibration's content as it is stored, for recordings; None:
            only the calibration itself is known.
        calibration_hash: the content's hash.
        table_file: the table as it is stored, an HDF5 file.
        radiometric: the radiometric calibration that peaks are found with; None: none.
        bad_pixels: pixels that are masked beside those of the radiometric calibration.
    """

    calibration_id: str | None = None
    calibration: Calibration | None = None
    table_id: str | None = None
    table: CorrectionTable | None = None
    calibration_content: Mapping[str, Any] | None = None
    calibration_hash: str | None = None
    table_file: bytes | None = None
    radiometric: ActiveRadiometric | None = None
    bad_pixels: tuple[LiveBadPixel, ...] = ()

    @property
    def nominal_remark(self) -> str | None:
        """What users of poses are to know of a profile's nominal calibration, else None."""
        profile = (self.calibration_content or {}).get("profile")
        if profile is None:
            return None
        return (
            f'its calibration is nominal: computed from the profile "{profile["profile_id"]}", not '
            "measured; its points and poses are those of a simulation"
        )

    def differs_in_bad_pixels_only(self, other: Self) -> bool:
        """Whether all but the bad pixels is the same, which are not."""
        return self.bad_pixels != other.bad_pixels and self._identity == other._identity

    @property
    def _identity(self) -> tuple[object, ...]:
        radiometric, calibration = self.radiometric, self.calibration
        return (
            self.calibration_id,
            # Of those that no service stored there is no hash.
            self.calibration_hash or (None if calibration is None else id(calibration)),
            self.table_id,
            radiometric and radiometric.content_hash,
        )


NO_ACTIVE_CALIBRATION: Final = ActiveCalibration()


@dataclass(frozen=True, eq=False)
class PreparedCalibration:
    """A calibration with its correction table, if any, and the solvers that frames need."""

    calibration_id: str
    calibration: Calibration
    table_id: str | None
    solver: PointSolver
    table: CorrectionTable | None = None
    model: MeasurementModel | None = None
    """The measurement model, for frames with many markers and for fused ones; None: only small
    ones are grouped."""

    @classmethod
    def of(cls, active: ActiveCalibration, compute_device: str | None) -> Self | None:
        """Prepare a calibration in milliseconds, in the thread that owns Warp; None: there is none.

        It takes longer when the calibration has more terms of distortion than any before.
        """
        calibration, table = active.calibration, active.table
        if active.calibration_id is None or calibration is None:
            return None
        covariance = _covariance(calibration, table)
        models = calibration.models
        return cls(
            active.calibration_id,
            calibration,
            None if table is None else active.table_id,
            PointSolver(models, covariance, table, compute_device, threads=1),
            table,
            MeasurementModel.of(models, covariance, table),
        )

    @cached_property
    def measurement_noise(self) -> MeasurementNoise:
        """Standard deviations of the sensors' readings, the calibration's misfit included."""
        return measurement_noise(self.calibration)

    @property
    def covariance(self) -> Array | None:
        """Covariance of the cameras' parameters; None with a correction table."""
        return _covariance(self.calibration, self.table)


def _covariance(calibration: Calibration, table: CorrectionTable | None) -> Array | None:
    # A table's variance is that of the whole reading, the calibration's share included.
    return np.array(calibration.covariance) if table is None else None
