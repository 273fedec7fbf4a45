"""Provenance of a frame: the calibration it was measured with, and whether that is still active."""

from dataclasses import dataclass

from sqlalchemy.orm import Session

from service.api.devices.store import active, active_at
from service.database.models import RegistrationRow


@dataclass(frozen=True)
class Provenance:
    """Calibration and table that were active when a frame was registered.

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
        with_what = [
            ("an active calibration", "calibration", self.calibration, calibration,
             "its world may be another"),
            ("a correction table", "correction table", self.table, table,
             "points are elsewhere by as much as a table corrects"),
        ]  # fmt: skip
        for none, name, measured_with, active_now, consequence in with_what[not self.fixed :]:
            if measured_with != active_now:
                measured = f"without {none}"
                if measured_with is not None:
                    measured = f'with {name} "{measured_with}"'
                now = "none" if active_now is None else f'"{active_now}"'
                return (
                    f'registration "{self.name}" was measured {measured}, and {now} is active: '
                    f"{consequence}; register again"
                )
        return None


def active_ids(session: Session, device_id: str) -> dict[str, str | None]:
    """Return the ids of the active calibration and table, as measurements store them."""
    pointer = active(session, device_id)
    return {
        "calibration_id": None if pointer is None else pointer.calibration_id,
        "table_id": None if pointer is None else pointer.table_id,
    }


def provenance(session: Session, row: RegistrationRow) -> Provenance:
    """Return what a registration was measured with."""
    table = row.result.get("table_id")
    if "table_id" not in row.result:  # stored by a version that did not keep it
        then = active_at(session, row.device_id, row.created_at)
        table = None if then is None else then.table_id
    return Provenance(row.id, row.reference_id is None, row.result.get("calibration_id"), table)
