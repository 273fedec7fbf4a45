"""Whether a new tool can be tracked, and told from the other tools of its device."""

from collections.abc import Sequence
from typing import Final

from compute.errors import DegenerateTool, IndistinguishableTools
from compute.pose.rigid_body import RigidBody

GEOMETRY: Final = (DegenerateTool, IndistinguishableTools)
"""What ``check_geometry`` raises."""


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
