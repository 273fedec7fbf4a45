"""Provenance of a frame: the calibration it was measured with, and whether that is still active."""

from dataclasses import dataclass

from sqlalchemy.orm import Session

from service.api.devices.activation import active, active_at
from service.database.models import RegistrationRow


@dataclass(frozen=True)
class Provenance:
    """What was active when a frame was registered.

    Args:
        name: of the frame.
        fixed: whether it was measured in the tracker's world; else relative to a tool.
        calibration: the calibration; None: there was none.
        table: its correction table; None: without one.
    """

    name: str
    fixed: bool
    calibration: str | None
    table: str | None

    def invalid_reason(self, calibration: str | None, table: str | None) -> str | None:
        """Return why the frame is invalid with this active calibration; None: it is valid.

        A frame that goes with a tool outlives another calibration, whose error is in the
        covariance of every pose. It does not outlive another table: what a table corrects was
        in no covariance, and it differs from place to place.
        """
        if self.fixed and self.calibration != calibration:
            measured = (
                "without an active calibration"
                if self.calibration is None
                else f'with calibration "{self.calibration}"'
            )
            now = "none" if calibration is None else f'"{calibration}"'
            return (
                f'registration "{self.name}" was measured {measured}, and {now} is in force: '
                "its world may be another; register again"
            )
        if self.table != table:
            measured = (
                "without a correction table"
                if self.table is None
                else f'with correction table "{self.table}"'
            )
            now = "none" if table is None else f'"{table}"'
            return (
                f'registration "{self.name}" was measured {measured}, and {now} is in force: '
                "points are elsewhere by as much as a table corrects; register again"
            )
        return None


def active_ids(session: Session, device_id: str) -> dict[str, str | None]:
    """Return the ids of the active calibration and table, as measurements store them."""
    pointer = active(session, device_id)
    return {
        "calibration": None if pointer is None else pointer.calibration_id,
        "table": None if pointer is None else pointer.table_id,
    }


def provenance(session: Session, row: RegistrationRow) -> Provenance:
    """Return what a registration was measured with."""
    table = row.result.get("table")
    if "table" not in row.result:  # stored by a version that did not keep it
        then = active_at(session, row.device_id, row.created_at)
        table = None if then is None else then.table_id
    return Provenance(row.id, row.reference_id is None, row.result.get("calibration"), table)
