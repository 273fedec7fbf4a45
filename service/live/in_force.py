"""InForce: the calibration that a device reconstructs with, and its correction table."""

from dataclasses import dataclass
from typing import Final

from compute.calibration.result import Calibration
from compute.mapping.table import CorrectionTable


@dataclass(frozen=True, eq=False)
class InForce:
    """What a device uses.

    Args:
        calibration_id: the calibration's id; None: none, there are peaks only.
        calibration: the calibration.
        table_id: the correction table's id; None: readings are not corrected.
        table: the table.
    """

    calibration_id: str | None = None
    calibration: Calibration | None = None
    table_id: str | None = None
    table: CorrectionTable | None = None


NOTHING: Final = InForce()
