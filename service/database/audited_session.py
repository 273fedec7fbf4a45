"""AuditedSession: writes the changes of a transaction to the audit log in that transaction."""

import hashlib
import json
from datetime import UTC, datetime
from typing import Any, Final

from sqlalchemy import event, inspect
from sqlalchemy.orm import ORMExecuteState, Session, UOWTransaction

from service.database.models import (
    TRANSIENT,
    ActivationRow,
    ActiveCalibrationRow,
    ApiKeyRow,
    AuditRow,
    Base,
    CaptureRow,
    IdempotencyKeyRow,
    RadiometricActivationRow,
    RadiometricCaptureRow,
    ReconstructionRow,
    RunRow,
    WatchSampleRow,
)
from service.principal import SERVICE, Act, current_act

_MAX_VALUE_CHARACTERS: Final = 500

_KINDS: Final = {"api_keys": "key", "activations": "activation", "watches": "watch"}
# Secrets, what is large and immutable anyway, and what every row has.
_REDACTED_COLUMNS: Final = frozenset(
    {
        "id",
        "digest",
        "secret",
        "data",
        "content",
        "errors",
        "poster",
        "created_at",
        "updated_at",
        "heartbeat_at",
    }
)
_SILENT_TABLES: Final = frozenset(
    {
        ActiveCalibrationRow.__tablename__,
        IdempotencyKeyRow.__tablename__,
        *(name for name, table in Base.metadata.tables.items() if TRANSIENT in table.info),
    }
)
_POINTER: Final = ("calibration_id", "table_id")
_RADIOMETRIC_POINTER: Final = ("radiometric_id",)


class AuditedSession(Session):
    """A session whose changes are in the audit log when they are in the database."""


@event.listens_for(AuditedSession, "before_flush")
def _record(session: Session, _flush: UOWTransaction, _objects: object) -> None:
    rows = []
    for row in session.new:
        if isinstance(row, ActivationRow | RadiometricActivationRow):
            rows.append(_activation(row))
        elif _is_audited(row) and not isinstance(row, ReconstructionRow):
            rows.append(_entry_of(row, after=_values(row)))
    rows += [
        _entry_of(row, *_difference(row))
        for row in session.dirty
        if _is_audited(row) and session.is_modified(row) and _is_actors_change(row)
    ]
    rows += [_entry_of(row, _values(row)) for row in session.deleted if _is_audited(row)]
    session.add_all(rows)


@event.listens_for(AuditedSession, "do_orm_execute")
def _record_many(execution: ORMExecuteState) -> Any:
    """Audit rows that are deleted in bulk, without their values."""
    if not execution.is_delete or execution.bind_mapper is None:
        return None
    table = execution.bind_mapper.class_.__tablename__
    result = execution.invoke_statement()
    if result.rowcount and table not in _SILENT_TABLES:  # type: ignore[attr-defined]
        count = result.rowcount  # type: ignore[attr-defined]
        row = entry(_KINDS.get(table, _singular(table)), None, "done", before={"rows": count})
        execution.session.add(row)
    return result


def entry(
    kind: str,
    identity: str | None,
    outcome: str,
    *,
    before: dict[str, Any] | None = None,
    after: dict[str, Any] | None = None,
    detail: str | None = None,
) -> AuditRow:
    """Return a row that says what the current act did, or wanted to do.

    Args:
        kind: of the object: ``device``, ``calibration``, ...
        identity: the object's id, where there is one.
        outcome: ``done`` or ``refused``.
        before: values that are no more.
        after: values from now on.
        detail: why it was refused.
    """
    act = current_act.get() or Act(SERVICE, "background")
    act.recorded = True
    return AuditRow(
        at=datetime.now(UTC),
        actor_kind=act.principal.kind,
        actor_id=act.principal.id[:200],
        actor_name=act.principal.name[:200],
        operation=act.operation[:64],
        outcome=outcome,
        object_kind=kind,
        object_id=identity,
        before=before,
        after=after,
        detail=detail,
        request_id=act.request_id,
        address=act.address,
    )


def kind_of(row: Base) -> str:
    """Return what the audit log calls a row: ``device``, ``correction-table``, ..."""
    table = type(row).__tablename__
    return _KINDS.get(table, _singular(table))


def _singular(table: str) -> str:
    return table.removesuffix("s").replace("_", "-")


def _is_audited(row: object) -> bool:
    # The move of the pointer is told by the row of its history; what was seen is no change.
    silent = AuditRow | ActiveCalibrationRow | WatchSampleRow | IdempotencyKeyRow
    return (
        isinstance(row, Base)
        and not isinstance(row, silent)
        and TRANSIENT not in type(row).metadata.tables[type(row).__tablename__].info
    )


def _is_actors_change(row: Base) -> bool:
    """Whether a change is somebody's doing, and no progress of work."""
    changed = _changed(row)
    if isinstance(row, RunRow):
        return "state" in changed and row.state == "cancelled"
    if isinstance(row, ApiKeyRow):
        return changed != {"last_used_at"}
    return True


def _activation(row: ActivationRow | RadiometricActivationRow) -> AuditRow:
    act = current_act.get()
    if row.actor is None and act is not None:
        row.actor = act.principal.label
    pointer = _POINTER if isinstance(row, ActivationRow) else _RADIOMETRIC_POINTER
    before = {name: getattr(row, f"previous_{name}") for name in pointer}
    after = {name: getattr(row, name) for name in pointer}
    if isinstance(row, ActivationRow) and row.restores_id is not None:
        after["restores_id"] = row.restores_id
    return entry("device", row.device_id, "done", before=before, after=after)


def _entry_of(
    row: Base, before: dict[str, Any] | None = None, after: dict[str, Any] | None = None
) -> AuditRow:
    identity = row.__dict__.get("id")
    redacted = [None if values is None else _redacted(values) for values in (before, after)]
    name = None if identity is None else str(identity)
    return entry(kind_of(row), name, "done", before=redacted[0], after=redacted[1])


def _values(row: Base) -> dict[str, Any]:
    """Return the loaded columns of a row; large files are not fetched."""
    return {name: row.__dict__[name] for name in _columns(row) if name in row.__dict__}


def _columns(row: Base) -> list[str]:
    return [attribute.key for attribute in inspect(type(row)).column_attrs]


def _changed(row: Base) -> set[str]:
    state = inspect(row)
    return {
        name
        for name in _columns(row)
        if name in row.__dict__ and state.attrs[name].history.has_changes()
    }


def _difference(row: Base) -> tuple[dict[str, Any], dict[str, Any]]:
    state = inspect(row)
    before, after = {}, {}
    for name in _changed(row):
        history = state.attrs[name].history
        before[name] = history.deleted[0] if history.deleted else None
        after[name] = row.__dict__[name]
    if isinstance(row, RadiometricCaptureRow) and "captured" in after:
        after["captured"] = [one["name"] for one in after["captured"]]
        before.pop("captured")
    if isinstance(row, CaptureRow) and "captured" in after:
        old = before.pop("captured") or {}
        new = after["captured"].items()
        after["captured"] = sorted(name for name, value in new if old.get(name) != value)
    return before, after


def _redacted(values: dict[str, Any]) -> dict[str, Any]:
    """Return values short enough for a log; long ones as size and hash."""
    return {
        name: _truncate(value)
        for name, value in sorted(values.items())
        if name not in _REDACTED_COLUMNS and value is not None and not isinstance(value, bytes)
    }


def _truncate(value: Any) -> Any:
    if isinstance(value, datetime):
        return value.astimezone(UTC).isoformat()
    text = json.dumps(value, sort_keys=True, default=str)
    if len(text) <= _MAX_VALUE_CHARACTERS:
        return value
    return {"sha256": hashlib.sha256(text.encode()).hexdigest(), "characters": len(text)}
