"""Runs in the database: the states of a run and their transitions."""

import os
import secrets
import socket
from collections.abc import Collection
from datetime import UTC, datetime, timedelta
from typing import Any, Final, Literal, get_args

from sqlalchemy import func, or_, select, update
from sqlalchemy.orm import Session

from compute.errors import LumilineError
from service.database.engine import Database, Resource, insert
from service.database.gateway import Gateway
from service.database.models import RunRow
from service.principal import current_act
from service.problems.errors import (
    Busy,
    CalibrationExists,
    CorrectionTableExists,
    ExportExists,
    RunExists,
    RunNotEnded,
    UnknownRun,
)

Kind = Literal["calibration", "self-calibration", "update", "mapping", "export"]
State = Literal["queued", "running", "succeeded", "failed", "cancelled", "interrupted"]
OPEN: Final = ("queued", "running")
STATES: Final[tuple[State, ...]] = get_args(State)

_RESULTS: Final[dict[Kind, tuple[str, type[LumilineError]]]] = {
    "mapping": ("correction table", CorrectionTableExists),
    "export": ("export", ExportExists),
}
"""What runs make that are no calibrations, and the error about an id that is taken."""

STALE_AFTER: Final = timedelta(seconds=60)
"""A running run whose server has not been heard of for so long has none any more."""


RUNS: Final = Resource(RunRow, "run", UnknownRun, RunExists)


def add_run(
    session: Session,
    kind: Kind,
    device_id: str,
    request: dict[str, Any],
    max_waiting: int,
    run_id: str | None = None,
    directory_id: str | None = None,
) -> RunRow:
    """Store a run that waits for its turn; ``directory_id``: where the files are that it needs.

    Raises:
        RunExists: the id is taken.
        CalibrationExists, CorrectionTableExists, ExportExists: another run that waits or runs is
            to make a result of the same id.
        Busy: the queue is full.
    """
    waiting = session.scalar(
        select(func.count()).select_from(RunRow).where(RunRow.state == "queued")
    )
    if (waiting or 0) >= max_waiting:
        raise Busy(f"{waiting} runs wait already, as many as may; send this one again later")
    result_id: str | None = request.get("result_id")
    claim = None if result_id is None else _claim_of(kind, result_id)
    if result_id is not None:
        other = session.scalar(select(RunRow.id).where(RunRow.claim == claim))
        if other is not None:
            raise _claimed(kind, result_id, other)
    row = RunRow(
        id=run_id or f"run-{secrets.token_hex(8)}",
        kind=kind,
        device_id=device_id,
        state="queued",
        progress=0.0,
        stage="waits for its turn",
        request=request,
        result_id=None,
        problem=None,
        poster=None if (act := current_act.get()) is None else act.as_stored(),
        owner=None,
        created_at=datetime.now(UTC),
        started_at=None,
        finished_at=None,
        heartbeat_at=None,
        claim=None,
        directory_id=directory_id,
    )
    RUNS.insert(session, row)
    if result_id is not None:
        row.claim = claim
        # Unique: of two transactions at the same moment, of any devices, one gets it.
        insert(session, row, _claimed(kind, result_id, None))
    return row


def _claim_of(kind: Kind, result_id: str) -> str:
    """Return what a run claims until it ends: the id of its result among those of its sort."""
    sort = {"mapping": "table", "export": "export"}.get(kind, "calibration")
    return f"{sort}/{result_id}"


def _claimed(kind: Kind, result_id: str, run_id: str | None) -> LumilineError:
    what, error = _RESULTS.get(kind, ("calibration", CalibrationExists))
    which = "another run" if run_id is None else f'run "{run_id}"'
    return error(
        f'{which} is to make {what} "{result_id}"; choose another result_id, leave it out, '
        "or cancel that run",
        run_id=run_id,
        result_id=result_id,
    )


def claim(session: Session, gateway: Gateway) -> RunRow | None:
    """Make the oldest waiting run that it can compute this server's own; None: there is none."""
    files = RunRow.directory_id.is_(None) | (RunRow.directory_id == gateway.directory_id)
    row = session.scalars(
        select(RunRow)
        .where(RunRow.state == "queued", files)
        .order_by(RunRow.created_at, RunRow.id)
        .limit(1)
        .with_for_update(skip_locked=True)
    ).first()
    if row is not None:
        now = datetime.now(UTC)
        row.state, row.stage, row.owner = "running", "starts", gateway.id
        row.started_at = row.heartbeat_at = now
        session.flush()
    return row


def report_progress(
    session: Session, run_id: str, owner: str, progress: float | None, stage: str | None
) -> bool:
    """Write down how far a run is; return whether it is still this server's to go on with."""
    values: dict[str, Any] = {"heartbeat_at": datetime.now(UTC)}
    if progress is not None:
        values["progress"] = min(max(progress, 0.0), 1.0)
    if stage is not None:
        values["stage"] = stage[:200]
    result = session.execute(
        update(RunRow)
        .where(RunRow.id == run_id, RunRow.state == "running", RunRow.owner == owner)
        .values(**values)
        .returning(RunRow.id)
    )
    return result.first() is not None


def running_runs(database: Database) -> list[str]:
    """Return the ids of the runs that are being computed, by any server."""
    with database.read() as session:
        return list(session.scalars(select(RunRow.id).where(RunRow.state == "running")))


def is_still_owner(session: Session, run_id: str, owner: str) -> RunRow | None:
    """Return a running run of this server, locked; None where it was cancelled or deleted."""
    return session.scalars(
        select(RunRow)
        .where(RunRow.id == run_id, RunRow.state == "running", RunRow.owner == owner)
        .with_for_update()
    ).first()


def finish(row: RunRow, state: State, stage: str, problem: dict[str, Any] | None = None) -> None:
    """End a run."""
    row.state, row.stage, row.problem = state, stage, problem
    row.finished_at = datetime.now(UTC)
    row.claim = None
    if state == "succeeded":
        row.progress = 1.0


def cancel(session: Session, run_id: str) -> RunRow:
    """End a run that waits or runs; one that has ended stays as it is. Raises UnknownRun."""
    row = RUNS.get(session, run_id, lock=True)
    if row.state in OPEN:
        finish(row, "cancelled", "cancelled on request")
        session.flush()
    return row


def delete_run(session: Session, run_id: str) -> None:
    """Delete a run that has ended; what it made stays.

    Raises:
        UnknownRun.
        RunNotEnded: it waits or runs.
    """
    row = RUNS.get(session, run_id, lock=True)
    if row.state in OPEN:
        raise RunNotEnded(
            f'run "{run_id}" is {row.state}; cancel it first, or wait for its end', run_id=run_id
        )
    session.delete(row)
    session.flush()


def interrupt_lost(
    session: Session,
    gateway: Gateway,
    computing: Collection[str] = (),
    *,
    starting: bool = False,
) -> list[str]:
    """End the runs whose server is gone and return their ids.

    Args:
        session: the session.
        gateway: this server; where it does not know which others live, the heartbeat of each run
            tells.
        computing: the runs that this server computes, whenever it was last heard of.
        starting: this server starts: what is called its own is of a process before it.
    """
    condition = gateway.is_gone(RunRow.owner)
    if condition is None:
        condition = RunRow.heartbeat_at < datetime.now(UTC) - STALE_AFTER
        if starting:
            condition = or_(condition, RunRow.owner.in_(_gone_or_own(session)))
    rows = session.scalars(
        select(RunRow)
        .where(RunRow.state == "running", RunRow.id.not_in(computing), condition)
        .with_for_update(skip_locked=True)
    ).all()
    for row in rows:
        finish(row, "interrupted", "the server ended while it ran; post it again")
    return [row.id for row in rows]


def _gone_or_own(session: Session) -> list[str]:
    """Return the owners of this machine whose process is gone, or has this one's id."""
    owners = session.scalars(select(RunRow.owner).where(RunRow.state == "running").distinct()).all()
    return [name for name in owners if name is not None and _is_gone(name)]


def _is_gone(name: str) -> bool:
    host, _, pid = name.rpartition("/")
    if host != socket.gethostname():
        return False
    if int(pid) == os.getpid():
        return True
    try:
        os.kill(int(pid), 0)
    except ProcessLookupError:
        return True
    except PermissionError:
        return False
    return False
