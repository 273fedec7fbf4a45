"""Stored tools as rigid bodies, and the check of a new one."""

from collections.abc import Sequence

import numpy as np
from sqlalchemy import select
from sqlalchemy.orm import Session

from compute.pose.rigid_body import RigidBody
from service.api.tools.schema import Tip, ToolLimits
from service.database.models import ToolRow


def body_of(row: ToolRow) -> RigidBody:
    """Return a stored tool as a rigid body; its name is the tool's id."""
    return RigidBody(
        name=row.id,
        markers_mm=np.array(row.markers_mm, dtype=np.float64),
        strobe_markers=None if row.strobe_markers is None else tuple(row.strobe_markers),
        tip_mm=tip_of(row).position_mm,
        max_tip_sd_mm=ToolLimits.model_validate(row.limits).tip_sd_mm,
    )


def tip_of(row: ToolRow) -> Tip:
    """Return where its tip is."""
    return Tip(position_mm=None) if row.tip is None else Tip.model_validate(row.tip)


def tools_of(session: Session, device_id: str) -> tuple[RigidBody, ...]:
    """Return all tools of a device, by id."""
    rows = select(ToolRow).where(ToolRow.device_id == device_id).order_by(ToolRow.id)
    return tuple(body_of(row) for row in session.scalars(rows))


def check_geometry(tool: RigidBody, others: Sequence[RigidBody]) -> None:
    """Check a new tool.

    Raises:
        DegenerateTool: its markers do not tell its pose.
        IndistinguishableTools: it looks like one of the others.
    """
    from compute.pose.acquisition.tool_geometry import check_distinguishable, check_tool

    check_tool(tool)
    for other in others:
        check_distinguishable((other, tool))
