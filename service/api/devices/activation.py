"""The pointer of a device to its active calibration and table: its moves and their history."""

from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime

from sqlalchemy import Select, select
from sqlalchemy.orm import Session

from service.database.models import (
    ActivationRow,
    ActiveCalibrationRow,
    CalibrationRow,
    DeviceRow,
)
from service.problems.errors import ActivationConflict, CalibrationRetired, NothingToRollBack


@dataclass(frozen=True)
class Target:
    """What a pointer points to.

    Args:
        calibration_id: the calibration.
        table_id: its correction table; None: without one.
        restores_id: the move of the history that is gone back to; None: a new one.
    """

    calibration_id: str
    table_id: str | None = None
    restores_id: int | None = None


def active(session: Session, device_id: str) -> Target | None:
    """Return what the device uses now, None without a calibration."""
    pointer = session.get(ActiveCalibrationRow, device_id, populate_existing=True)
    return None if pointer is None else Target(pointer.calibration_id, pointer.table_id)


def active_at(session: Session, device_id: str, moment: datetime) -> Target | None:
    """Return what the device used at a moment, None without a calibration."""
    query = (
        select(ActivationRow)
        .where(ActivationRow.device_id == device_id, ActivationRow.activated_at <= moment)
        .order_by(ActivationRow.id.desc())
        .limit(1)
    )
    found = session.scalars(query).first()
    return None if found is None else Target(found.calibration_id, found.table_id)


def lock_device(session: Session, device_id: str) -> None:
    """Let other moves of the pointer wait (SQLite: they do from the transaction's begin)."""
    session.execute(select(DeviceRow.id).where(DeviceRow.id == device_id).with_for_update())


def check_not_retired(row: CalibrationRow) -> None:
    """Raise CalibrationRetired when a calibration may not be activated any more."""
    if row.retired_at is not None:
        raise CalibrationRetired(
            f'calibration "{row.id}" was retired on {row.retired_at:%Y-%m-%d}; activate one that '
            "is available",
            calibration=row.id,
        )


def move_pointer(
    session: Session, device_id: str, target: Target, actor: str | None = None
) -> None:
    """Point the device to a calibration and table and write the move down; both or neither.

    Where it points there already nothing is changed or written. The device is locked.
    """
    pointer = session.get(ActiveCalibrationRow, device_id, populate_existing=True)
    before = None if pointer is None else (pointer.calibration_id, pointer.table_id)
    if before == (target.calibration_id, target.table_id):
        return
    if pointer is None:
        pointer = ActiveCalibrationRow(device_id=device_id)
        session.add(pointer)
    pointer.calibration_id, pointer.table_id = target.calibration_id, target.table_id
    session.add(
        ActivationRow(
            device_id=device_id,
            calibration_id=target.calibration_id,
            previous_calibration_id=before[0] if before else None,
            table_id=target.table_id,
            previous_table_id=before[1] if before else None,
            restores_id=target.restores_id,
            activated_at=datetime.now(UTC),
            actor=actor,
        )
    )
    session.flush()


def previous_activation(session: Session, device_id: str) -> Target:
    """Return what the device used before its last move; raises NothingToRollBack.

    A move that was a roll-back stands where it went back to: rolling back again goes further.
    """
    newest = _latest_activation(session, device_id, None)
    reached = newest and (newest.restores_id or newest.id)
    earlier = _latest_activation(session, device_id, reached) if reached else None
    if earlier is None:
        raise NothingToRollBack(
            f'device "{device_id}" has no activation before the present one; activate a '
            "calibration by its id",
            device=device_id,
        )
    return Target(earlier.calibration_id, earlier.table_id, earlier.restores_id or earlier.id)


def _latest_activation(
    session: Session, device_id: str, before: int | None
) -> ActivationRow | None:
    query = select(ActivationRow).where(ActivationRow.device_id == device_id)
    if before is not None:
        query = query.where(ActivationRow.id < before)
    return session.scalars(query.order_by(ActivationRow.id.desc()).limit(1)).first()


def activations(device_id: str) -> Select[ActivationRow]:
    """Return a device's activations, newest first."""
    return (
        select(ActivationRow)
        .where(ActivationRow.device_id == device_id)
        .order_by(ActivationRow.id.desc())
    )


IsReached = Callable[[Target], bool]


@dataclass(frozen=True)
class ActivationPrecondition:
    """Precondition of an activation (optimistic concurrency).

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
    """Return the precondition as of now."""
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
