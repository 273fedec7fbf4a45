"""Tools and their calibrations in the database."""

import secrets
from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Any, Final

from sqlalchemy import Select, func, select
from sqlalchemy.orm import Session

from compute.errors import InvalidParameter
from compute.pose.rigid_body import RigidBody
from service.api.base_models import Position, from_attributes
from service.api.tools.rigid_bodies import tip_of
from service.api.tools.rigid_bodies import tools_of as tools_of
from service.api.tools.schema import (
    TRACKER,
    NewCapturedTool,
    NewTool,
    NewToolCalibration,
    Origin,
    Tip,
    Tool,
    ToolCalibration,
    ToolChange,
)
from service.database.engine import Resource
from service.database.models import HoldRow, RegistrationRow, ToolCalibrationRow, ToolRow
from service.database.referrers import refuse_if_referred
from service.problems.errors import (
    MarkersTaken,
    ToolExists,
    ToolInUse,
    ToolReplaced,
    TooManyTools,
    UnknownTool,
)

MAX_TOOLS: Final = 32
"""Of one device."""


TOOLS: Final = Resource(
    ToolRow, "tool", UnknownTool, ToolExists, taken="exists already; choose another id"
)


def get_same_tool(session: Session, tool_id: str, created_at: datetime) -> ToolRow:
    """Return a tool that was measured; raises UnknownTool, or ToolReplaced when it is another."""
    row = TOOLS.get(session, tool_id)
    if row.created_at != created_at:
        raise ToolReplaced(
            f'tool "{tool_id}" was deleted and created again while it was measured; what was found '
            "is of the former one and was not kept; do it again",
            tool_id=tool_id,
        )
    return row


def tools(device_id: str | None) -> Select[ToolRow]:
    """Return those that the filter matches, by id."""
    found = select(ToolRow).order_by(ToolRow.id)
    return found if device_id is None else found.where(ToolRow.device_id == device_id)


def check_free(session: Session, identity: str, resource: Resource[Any] = TOOLS) -> None:
    """Raise an error of a resource when a tool, or the frame of a registration, has this id."""
    if identity == TRACKER:
        raise InvalidParameter(
            f'"{TRACKER}" is the name of the device\'s own frame; choose another id'
        )
    for table, what in ((ToolRow, "tool"), (RegistrationRow, "registration")):
        if session.get(table, identity) is not None:
            detail = f'{what} "{identity}" exists already; choose another id'
            raise resource.exists(detail, **{f"{resource.key}_id": identity})


def check_new(
    session: Session, request: NewTool | NewCapturedTool, strobe_markers: Sequence[int] | None
) -> None:
    """Check all of a new tool but its geometry; the device's row is locked.

    Raises:
        ToolExists: the id is taken.
        TooManyTools: the device has as many as it may.
        UnknownTool: the reference is none.
        MarkersTaken: another tool has a strobed marker of it.
        InvalidParameter: a marker is named twice, or the reference is another device's.
    """
    check_free(session, request.id)
    device = request.device_id
    count = session.scalar(
        select(func.count()).select_from(ToolRow).where(ToolRow.device_id == device)
    )
    if (count or 0) >= MAX_TOOLS:
        raise TooManyTools(
            f'device "{device}" has {count} tools already, as many as it may; delete one',
            tools=count,
        )
    _check_reference(session, request.id, device, request.reference_id)
    if strobe_markers is None:
        return
    if len(set(strobe_markers)) != len(strobe_markers):
        raise InvalidParameter(
            f"strobe_markers is {list(strobe_markers)}; each marker must have a number of its own"
        )
    for other in session.scalars(tools(device)):
        taken = sorted(set(other.strobe_markers or ()) & set(strobe_markers))
        if taken:
            raise MarkersTaken(
                f'marker {taken[0]} belongs to tool "{other.id}" of device "{device}"; give each '
                "tool markers of its own",
                tool_id=other.id,
                markers=taken,
            )


def _check_reference(session: Session, tool_id: str, device_id: str, reference: str | None) -> None:
    if reference is None:
        return
    if reference == tool_id:
        raise InvalidParameter(f'tool "{tool_id}" cannot be its own reference; name another')
    other = TOOLS.get(session, reference)
    if other.device_id != device_id:
        raise InvalidParameter(
            f'tool "{reference}" is of device "{other.device_id}"; a reference must be of the same '
            f'device, "{device_id}"',
            reference_id=reference,
        )
    chain = [reference]
    while (further := other.reference_id) is not None and further not in chain:
        chain.append(further)
        if further == tool_id:
            listed = " to ".join(f'"{one}"' for one in (tool_id, *chain))
            raise InvalidParameter(
                f"tools would be relative to one another: {listed}; name a reference that does "
                "not lead back",
                reference_id=reference,
            )
        other = TOOLS.get(session, further)


def add_tool(
    session: Session,
    request: NewTool | NewCapturedTool,
    body: RigidBody,
    origin: Origin,
) -> ToolRow:
    """Store a tool that was checked; raises ToolExists when another request was first."""
    now = datetime.now(UTC)
    row = ToolRow(
        id=request.id,
        device_id=request.device_id,
        title=request.title,
        markers_mm=body.markers_mm.tolist(),
        strobe_markers=None if body.strobe_markers is None else list(body.strobe_markers),
        tip=_given_tip(request.tip_mm),
        reference_id=request.reference_id,
        limits=request.limits.model_dump(mode="json"),
        origin=origin.model_dump(mode="json"),
        note=request.note,
        created_at=now,
        updated_at=now,
    )
    return TOOLS.insert(session, row)


def change_tool(session: Session, row: ToolRow, change: ToolChange) -> ToolRow:
    """Change what the request gives.

    Raises:
        UnknownTool, InvalidParameter: the reference cannot be one.
    """
    given = change.model_fields_set
    for name in given & {"title", "note"}:
        setattr(row, name, getattr(change, name))
    if "tip_mm" in given:
        # The axis of a spin calibration goes with the geometry, not with the tip.
        kept = tip_of(row).axis
        row.tip = _given_tip(change.tip_mm, kept)
    if "reference_id" in given:
        _check_reference(session, row.id, row.device_id, change.reference_id)
        row.reference_id = change.reference_id
    if "limits" in given:
        row.limits = change.limits.model_dump(mode="json")
    row.updated_at = datetime.now(UTC)
    session.flush()
    return row


def _given_tip(position_mm: Position | None, axis: Position | None = None) -> dict[str, Any] | None:
    if position_mm is None and axis is None:
        return None
    return Tip(position_mm=position_mm, axis=axis).model_dump(mode="json")


def delete_tool(session: Session, row: ToolRow) -> None:
    """Delete a tool and its calibrations.

    Raises:
        ToolInUse: another tool's poses, or a registration, are relative to it, or a hold watches
            it.
    """
    refuse_if_referred(
        session,
        ToolInUse,
        row,
        "delete or change them first",
        {
            "holds": (HoldRow, HoldRow.tool_id == row.id),
            "tools": (ToolRow, ToolRow.reference_id == row.id),
            "registrations": (RegistrationRow, RegistrationRow.reference_id == row.id),
        },
    )
    for one in session.scalars(calibrations(row.id)):
        session.delete(one)
    session.flush()
    session.delete(row)
    session.flush()


def calibrations(tool_id: str) -> Select[ToolCalibrationRow]:
    """Return a tool's calibrations."""
    return select(ToolCalibrationRow).filter_by(tool_id=tool_id)


def add_calibration(
    session: Session,
    tool: ToolRow,
    kind: str,
    asked: NewToolCalibration,
    result: dict[str, Any],
) -> ToolCalibrationRow:
    """Store what a calibration found, and give it to the tool where that is asked.

    Args:
        session: the session.
        tool: the tool.
        kind: ``pivot`` or ``spin``.
        asked: the request.
        result: the members of ToolCalibration that it found.
    """
    row = ToolCalibrationRow(
        id=f"{kind}-{secrets.token_hex(8)}",
        device_id=tool.device_id,
        tool_id=tool.id,
        kind=kind,
        asked=asked.model_dump(mode="json"),
        result=result,
        applied=asked.apply,
        created_at=datetime.now(UTC),
    )
    session.add(row)
    session.flush()
    if asked.apply:
        tip = tip_of(tool)
        found: dict[str, Any] = {"axis": result["axis"]}
        if kind == "pivot":
            found = {
                "position_mm": result["tip_mm"],
                "covariance_mm2": result["tip_covariance_mm2"],
                "tool_calibration_id": row.id,
            }
        tool.tip = Tip.model_validate(tip.model_dump() | found).model_dump(mode="json")
        tool.updated_at = row.created_at
        session.flush()
    return row


def calibration_document(row: ToolCalibrationRow) -> ToolCalibration:
    """Return a calibration as clients see it."""
    return from_attributes(ToolCalibration, row, **row.result, request=row.asked)


def document(row: ToolRow) -> Tool:
    """Return a tool as clients see it."""
    return from_attributes(Tool, row, tip=tip_of(row))
