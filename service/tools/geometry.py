"""Whether a new tool can be tracked, and told from the other tools of its device."""

from collections.abc import Sequence
from typing import Final

from compute.errors import DegenerateTool, LookAlikeTools
from compute.pose.rigid_body import RigidBody

GEOMETRY: Final = (DegenerateTool, LookAlikeTools)
"""What ``check_geometry`` raises."""


def check_geometry(tool: RigidBody, others: Sequence[RigidBody]) -> None:
    """Check a new tool.

    Raises:
        DegenerateTool: its markers do not tell its pose.
        LookAlikeTools: it looks like one of the others.
    """
    from compute.pose.geometry import check_look_alikes, check_tool

    check_tool(tool)
    for other in others:
        check_look_alikes((other, tool))
