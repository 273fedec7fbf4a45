"""ActiveCalibration: the calibration that a device reconstructs with, and its correction table."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from compute.calibration.result import Calibration
from compute.mapping.table import CorrectionTable


@dataclass(frozen=True, eq=False)
class ActiveCalibration:
    """What a device uses.

    Args:
        calibration_id: the calibration's id; None: none, there are peaks only.
        calibration: the calibration.
        table_id: the correction table's id; None: readings are not corrected.
        table: the table.
        calibration_content: the calibration's content as it is stored, for recordings; None:
            only the calibration itself is known.
        calibration_hash: the content's hash.
        table_file: the table as it is stored, an HDF5 file.
    """

    calibration_id: str | None = None
    calibration: Calibration | None = None
    table_id: str | None = None
    table: CorrectionTable | None = None
    calibration_content: Mapping[str, Any] | None = None
    calibration_hash: str | None = None
    table_file: bytes | None = None


NO_ACTIVE_CALIBRATION: Final = ActiveCalibration()
