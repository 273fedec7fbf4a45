"""Beam holds in the database."""

import secrets
from datetime import UTC, datetime
from typing import Any, Final

from sqlalchemy import Select, func, select
from sqlalchemy.orm import Session

from compute.errors import InvalidParameter
from service.api.base_models import from_attributes
from service.api.beam_holds.monitor_config import to_limits, to_spec, to_watch, validate_reference
from service.api.beam_holds.schema import (
    BeamHold,
    BeamHoldChange,
    Limits,
    NewBeamHold,
    Reference,
    ReferenceInput,
    Rules,
    ToolWatch,
)
from service.api.devices.store import active
from service.api.tools.store import TOOLS
from service.database.engine import Resource
from service.database.models import HoldRow
from service.problems.errors import (
    BeamHoldExists,
    BeamHoldReplaced,
    TooManyBeamHolds,
    UnknownBeamHold,
)

BEAM_HOLDS: Final = Resource(
    HoldRow,
    "hold",
    UnknownBeamHold,
    BeamHoldExists,
    taken="exists already; choose another id",
    path="/api/v1/beam-holds",
)
MAX_BEAM_HOLDS: Final = 8
"""Of one device: each takes its time with every frame."""


def reference_id(row: HoldRow) -> str | None:
    """Return which reference a hold has; None: it has none."""
    return None if row.reference is None else str(row.reference["id"])


def get_same_beam_hold(
    session: Session, hold_id: str, created_at: datetime, reference: str | None
) -> HoldRow:
    """Return a hold that was measured for.

    Raises:
        UnknownBeamHold.
        BeamHoldReplaced: it is another, or its reference was changed meanwhile.
    """
    row = BEAM_HOLDS.get(session, hold_id)
    if reference_id(row) != reference:
        raise BeamHoldReplaced(
            f'the reference of hold "{hold_id}" was changed or taken away while this one was '
            "measured, which was not kept; do it again",
            hold_id=hold_id,
        )
    if row.created_at != created_at:
        raise BeamHoldReplaced(
            f'hold "{hold_id}" was deleted and created again while its reference was measured, '
            "which was not kept; do it again",
            hold_id=hold_id,
        )
    return row


def holds(device_id: str | None) -> Select[HoldRow]:
    """Return those that the filter matches."""
    found = select(HoldRow)
    return found if device_id is None else found.where(HoldRow.device_id == device_id)


def add_beam_hold(session: Session, request: NewBeamHold) -> HoldRow:
    """Store a hold; the device's row is locked.

    Raises:
        BeamHoldExists: the id is taken.
        TooManyBeamHolds: the device has as many as it may.
        UnknownTool: there is no such tool.
        InvalidParameter: what is asked contradicts itself, or the tool is another device's.
    """
    BEAM_HOLDS.check_unused(session, request.id)
    device = request.device_id
    count = session.scalar(
        select(func.count()).select_from(HoldRow).where(HoldRow.device_id == device)
    )
    if (count or 0) >= MAX_BEAM_HOLDS:
        raise TooManyBeamHolds(
            f'device "{device}" has {count} holds already, as many as it may; delete one',
            holds=count,
        )
    watch = request.watch
    to_spec(watch)
    to_limits(request.limits, request.rules, watch)
    tool_id = watch.tool_id if isinstance(watch, ToolWatch) else None
    if tool_id is not None:
        tool = TOOLS.get(session, tool_id)
        if tool.device_id != device:
            raise InvalidParameter(
                f'tool "{tool_id}" is of device "{tool.device_id}"; a hold of "{device}" watches '
                "its own",
                tool_id=tool_id,
            )
    now = datetime.now(UTC)
    members = request.model_dump(mode="json", exclude={"device_id", "reference"})
    row = HoldRow(
        device_id=device, tool_id=tool_id, reference=None, created_at=now, updated_at=now, **members
    )
    if request.reference is not None:
        row.reference = _given(session, row, request.reference)
    return BEAM_HOLDS.insert(session, row)


def change_beam_hold(session: Session, row: HoldRow, change: BeamHoldChange) -> HoldRow:
    """Change what the request gives; raises InvalidParameter: it contradicts itself."""
    members = change.model_dump(mode="json", exclude_unset=True)
    limits = Limits.model_validate(row.limits | members.get("limits", {}))
    rules = Rules.model_validate(row.rules | members.get("rules", {}))
    to_limits(limits, rules, to_watch(row))
    members |= {"limits": limits.model_dump(mode="json"), "rules": rules.model_dump(mode="json")}
    for name, value in members.items():
        setattr(row, name, value)
    row.updated_at = datetime.now(UTC)
    session.flush()
    return row


def set_given(session: Session, row: HoldRow, given: ReferenceInput) -> HoldRow:
    """Give a hold a reference with the calibration that is active; raises InvalidParameter."""
    return set_reference(session, row, _given(session, row, given))


def set_reference(session: Session, row: HoldRow, reference: dict[str, Any] | None) -> HoldRow:
    """Give a hold a completed reference; None: take it away, and the beam is held."""
    row.reference = reference
    row.updated_at = datetime.now(UTC)
    session.flush()
    return row


def _given(session: Session, row: HoldRow, given: ReferenceInput) -> dict[str, Any]:
    members = validate_reference(given, to_watch(row))
    pointer = active(session, row.device_id)
    if pointer is None:
        return complete_reference(members, None, None)
    return complete_reference(members, pointer.calibration_id, pointer.table_id)


def complete_reference(
    members: dict[str, Any], calibration: str | None, table: str | None
) -> dict[str, Any]:
    """Return a reference as it is stored, with its id, time, calibration and table."""
    own = {
        "id": f"reference-{secrets.token_hex(8)}",
        "calibration_id": calibration,
        "table_id": table,
        "set_at": datetime.now(UTC).isoformat(),
    }
    return Reference.model_validate(members | own).model_dump(mode="json")


def document(row: HoldRow) -> BeamHold:
    """Return a hold as clients see it."""
    return from_attributes(BeamHold, row)
