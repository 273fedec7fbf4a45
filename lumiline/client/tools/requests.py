"""Requests about tools, their calibration, and points measured with them, for both clients."""

from collections.abc import Mapping, Sequence
from typing import Any

from lumiline.client.api_request import ApiRequest, get, post
from lumiline.client.response_model import Vector3
from lumiline.client.tools import models as d


def tools(device_id: str | None) -> ApiRequest[d.Tool]:
    """Tools."""
    return get(d.Tool, "tools", device=device_id)


def tool(tool_id: str) -> ApiRequest[d.Tool]:
    """One tool."""
    return get(d.Tool, "tools", tool_id)


def create_tool(
    tool_id: str, device_id: str, markers_mm: Sequence[Vector3], members: Mapping[str, Any]
) -> ApiRequest[d.Tool]:
    """Make a tool of known geometry."""
    markers = [list(map(float, marker)) for marker in markers_mm]
    body = {"title": tool_id, **members, "id": tool_id, "device": device_id, "markers_mm": markers}
    return post(d.Tool, "tools", body=body)


def capture_tool(
    tool_id: str, device_id: str, seconds: float, members: Mapping[str, Any]
) -> ApiRequest[d.Tool]:
    """Make a tool of what a device sees of it."""
    given = {"title": tool_id, **members}
    body = {name: value for name, value in given.items() if value is not None}
    body |= {"id": tool_id, "device": device_id, "seconds": seconds}
    return post(d.Tool, "tool-captures", body=body)


def tool_pose(tool_id: str, frame: str | None) -> ApiRequest[d.Pose]:
    """The newest pose of a tool."""
    return get(d.Pose, "tools", tool_id, "pose", frame=frame)


def calibrate_tool(
    tool_id: str, kind: str, seconds: float, *, apply: bool
) -> ApiRequest[d.ToolCalibration]:
    """Pivot or spin calibration."""
    body = {"seconds": seconds, "apply": apply}
    return post(d.ToolCalibration, "tools", tool_id, f"{kind}-calibrations", body=body)


def measure_point(
    tool_id: str, frame: str | None, name: str | None, timeout_s: float, members: Mapping[str, Any]
) -> ApiRequest[d.MeasuredPoint]:
    """Where a tool's tip is held still."""
    body = {**members, "frame": frame, "name": name, "timeout_s": timeout_s}
    return post(d.MeasuredPoint, "tools", tool_id, "points", body=body)
