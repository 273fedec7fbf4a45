"""Tools and tracking settings from JSON files in the form of the REST API."""

from pathlib import Path
from typing import Final

import numpy as np
from pydantic import AliasChoices, BaseModel, Field, TypeAdapter

from compute.errors import InvalidParameter
from compute.pose.acquisition.tool_geometry import check_distinguishable, check_tool
from compute.pose.rigid_body import RigidBody
from service.api.base_models import Position, Slug
from service.api.devices.tracking_settings import Tracking
from service.api.tools.schema import ToolLimits
from service.cli.json_files import read_json, validate


class _Tip(BaseModel):
    position_mm: Position | None = None


class _Tool(BaseModel):
    name: Slug = Field(validation_alias=AliasChoices("id", "name"))
    markers_mm: list[Position]
    strobe_markers: list[int] | None = None
    tip_mm: Position | None = None
    tip: _Tip | None = None
    limits: ToolLimits = Field(default_factory=ToolLimits)
    device_id: Slug | None = None


_TOOLS: Final = TypeAdapter(list[_Tool])


def read_tools(path: Path, device: str | None = None) -> tuple[RigidBody, ...]:
    """Return the tools in a file: a list of them, or an object with the list ``items``.

    A tool has ``id``, ``markers_mm`` and, if it has them, ``strobe_markers``, ``tip_mm`` and
    ``limits``; what else ``GET /api/v1/tools`` sends of it is not looked at.

    Args:
        path: the file.
        device: whose tools are wanted; those that say that they are another's are left out. None:
            all.

    Raises:
        InvalidParameter: the file cannot be read, or holds no tools.
        LumilineError: the markers of a tool make no pose, or two tools are alike.
    """
    content = read_json(path)
    listed = validate(
        _TOOLS,
        content["items"] if isinstance(content, dict) and "items" in content else content,
        path,
        "no tools",
        'a tool is {"id": "probe", "markers_mm": [[0, 0, 0], ...]}, with "strobe_markers", '
        '"tip_mm" and "limits" if it has them',
    )
    tools = tuple(_body(one) for one in listed if device is None or one.device_id in (None, device))
    names = [one.name for one in tools]
    if len(set(names)) < len(names):
        raise InvalidParameter(f"{path} has tools of one name: {', '.join(names)}")
    for tool in tools:
        slots = tool.strobe_markers
        if slots is not None and len(slots) != len(tool):
            raise InvalidParameter(
                f'tool "{tool.name}" has {len(tool)} markers and {len(slots)} strobe_markers; '
                "each marker has one"
            )
        check_tool(tool)
    check_distinguishable(tools)
    return tools


def _body(tool: _Tool) -> RigidBody:
    tip = tool.tip_mm or (tool.tip.position_mm if tool.tip else None)
    return RigidBody(
        tool.name,
        np.array(tool.markers_mm, np.float64).reshape(-1, 3),
        None if tool.strobe_markers is None else tuple(tool.strobe_markers),
        tip,
        tool.limits.tip_sd_mm,
    )


class DeviceTracking(BaseModel):
    """A device as far as tracking goes."""

    id: Slug
    tracking: Tracking


def read_device(path: Path) -> DeviceTracking:
    """Return what the answer of ``GET /api/v1/devices/{id}`` in a file says of tracking.

    Raises:
        InvalidParameter: the file cannot be read, or holds no device.
    """
    hint = "it must be the answer of GET /api/v1/devices/{id}"
    return validate(TypeAdapter(DeviceTracking), read_json(path), path, "no device", hint)
