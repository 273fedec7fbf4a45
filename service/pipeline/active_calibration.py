"""ActiveCalibration: what a device reconstructs with; PreparedCalibration: the same, for frames."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from compute.calibration.result import Calibration, measurement_noise
from compute.mapping.table import CorrectionTable
from compute.measurement.measurement_model import MeasurementModel
from compute.measurement.measurements import MeasurementNoise
from compute.reconstruction.solver import PointSolver
from compute.signal.radiometric_calibration import RadiometricCalibration

Array = NDArray[np.float64]


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
    """

    calibration_id: str | None = None
    calibration: Calibration | None = None
    table_id: str | None = None
    table: CorrectionTable | None = None
    calibration_content: Mapping[str, Any] | None = None
    calibration_hash: str | None = None
    table_file: bytes | None = None
    radiometric: ActiveRadiometric | None = None


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
    """The measurement model, for frames with many markers; None: only small ones are grouped."""

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
