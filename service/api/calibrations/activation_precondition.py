"""What a request to move a device's pointer goes by, and whether that still holds."""

from collections.abc import Callable
from dataclasses import dataclass

from sqlalchemy import select
from sqlalchemy.orm import Session

from service.api.calibrations.activation import Target, active
from service.database.models import ActivationRow
from service.problems.errors import ActivationConflict

IsReached = Callable[[Target], bool]


@dataclass(frozen=True)
class ActivationPrecondition:
    """How things stood when a request came.

    Args:
        device_id: the device.
        last_move: the newest move of its history.
        expected: the calibration that the client believes to be active; None: it did not say.
    """

    device_id: str
    last_move: int | None
    expected: str | None = None


def activation_precondition(
    session: Session, device_id: str, expected: str | None = None
) -> ActivationPrecondition:
    """Return how things stand now."""
    return ActivationPrecondition(device_id, _last_move(session, device_id), expected)


def check_activation_precondition(
    session: Session, basis: ActivationPrecondition, reached: IsReached
) -> None:
    """Raise ActivationConflict when another move came first; the device is locked.

    Of requests at the same moment one wins, and the others decide anew. Where the device is already
    as the request wants it (``reached``), nothing is in conflict: it may be sent again.
    """
    now = active(session, basis.device_id)
    if now is not None and reached(now):
        return
    shown = "none" if now is None else f'"{now.calibration_id}"'
    if now is not None and now.table_id is not None:
        shown += f' with table "{now.table_id}"'
    if basis.expected is not None and (now is None or now.calibration_id != basis.expected):
        raise ActivationConflict(
            f'device "{basis.device_id}" uses the calibration {shown}, not "{basis.expected}" as '
            "the request expects; look at its activations, and ask again",
            device=basis.device_id,
            expected=basis.expected,
            active=None if now is None else now.calibration_id,
        )
    if _last_move(session, basis.device_id) != basis.last_move:
        raise ActivationConflict(
            f'another request was first, and device "{basis.device_id}" uses the calibration '
            f"{shown} now; look at its activations, and ask again",
            device=basis.device_id,
            active=None if now is None else now.calibration_id,
        )


def _last_move(session: Session, device_id: str) -> int | None:
    query = select(ActivationRow.id).where(ActivationRow.device_id == device_id)
    return session.scalars(query.order_by(ActivationRow.id.desc()).limit(1)).first()
