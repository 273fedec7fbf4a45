"""Entries of the audit log in a transaction of their own, for requests that change no row."""

import logging
from collections.abc import Callable
from functools import partial
from typing import Final, Literal

from anyio import move_on_after
from anyio.to_thread import run_sync
from sqlalchemy.exc import SQLAlchemyError
from starlette.types import Scope

from service.database.audited_session import entry
from service.database.engine import Database
from service.database.models import AuditRow
from service.logs import decoded, redact
from service.principal import Act, current_act
from service.problems.errors import NotReady

_log = logging.getLogger(__name__)

_WAITED_S: Final = 2.0
"""A database that is slower writes the entry down later, and the answer does not wait for it."""

_KINDS = {
    "devices": "device",
    "calibrations": "calibration",
    "correction-tables": "correction-table",
    "runs": "run",
    "captures": "capture",
    "keys": "key",
    "reconstructions": "reconstruction",
    "exports": "export",
}


async def record_act(
    scope: Scope, act: Act, outcome: Literal["done", "refused"], detail: str | None
) -> None:
    """Write down what an act did beside the database, or wanted to do; never raises.

    A database that does not answer keeps no device from being stopped; the log says so then.
    """
    kind, identity = _object(scope["path"])
    redacted = None if detail is None else redact(detail)
    row = partial(entry, kind, identity, outcome, detail=redacted)
    await _record(scope["app"].state.database, act, outcome, row)


async def record_repeats(database: Database, act: Act, more: int) -> None:
    """Write down how often the same was refused again; never raises."""
    detail = f"{more} more of this operation, refused within a minute for lack of the scope"
    row = partial(entry, "server", None, "refused", detail=detail)
    await _record(database, act, "refused", row)


async def _record(database: Database, act: Act, outcome: str, row: Callable[[], AuditRow]) -> None:
    problem = None
    try:
        with move_on_after(_WAITED_S) as waited:
            await run_sync(_write, database, act, row, abandon_on_cancel=True)
        if waited.cancelled_caught:
            problem = "is not written down yet: the database is slow"
    except (SQLAlchemyError, NotReady):
        problem = "could not be written down"
    if problem is not None:
        who = act.principal.label
        _log.error("audit: %s by %s, %s, %s", act.operation, who, outcome, problem)


def _write(database: Database, act: Act, row: Callable[[], AuditRow]) -> None:
    token = current_act.set(act)
    try:
        with database.write() as session:
            session.add(row())
    finally:
        current_act.reset(token)


def _object(path: str) -> tuple[str, str | None]:
    """Return kind and id of what a path names: /api/v1/devices/sim/start is of device sim.

    The path is as it came: a whole key in the place of its id is not to stay in the log for good.
    """
    parts = path.strip("/").split("/")[2:]
    kind = _KINDS.get(parts[0], parts[0].removesuffix("s")) if parts else "server"
    return kind[:32], redact(decoded(parts[1]))[:200] if len(parts) > 1 else None
