"""Requests about tools, their calibration, and points measured with them."""

from collections.abc import Sequence
from typing import Any

from lumiline.client.exchange import ClientMethod, Exchange, delete, float_rows, get, get_all, send
from lumiline.client.models import MeasuredPoint, Pose, Tool, ToolCalibration, Vector3


class ToolMethods:
    """Requests about tools, their calibration, and points measured with them."""

    @ClientMethod
    def tools(self, device_id: str | None = None) -> Exchange[list[Tool]]:
        """Tools, of one device."""
        return get_all(Tool, "tools", device=device_id)

    @ClientMethod
    def tool(self, tool_id: str) -> Exchange[Tool]:
        """One tool."""
        return get(Tool, "tools", tool_id)

    @ClientMethod
    def create_tool(
        self, /, tool_id: str, device_id: str, markers_mm: Sequence[Vector3], **members: Any
    ) -> Exchange[Tool]:
        """Make a tool of known geometry; ``members`` as in the body of POST /api/v1/tools."""
        body = {
            "title": tool_id,
            **members,
            "id": tool_id,
            "device": device_id,
            "markers_mm": float_rows(markers_mm),
        }
        return send(Tool, "POST", "tools", body=body)

    @ClientMethod
    def capture_tool(
        self, /, tool_id: str, device_id: str, *, seconds: float = 1.0, **members: Any
    ) -> Exchange[Tool]:
        """Measure a tool's geometry: hold it still before a running device.

        Args:
            tool_id: the id that it gets.
            device_id: the device.
            seconds: how long it is measured [s].
            members: others of the body of POST /api/v1/tool-captures, such as ``markers``, how many
                are lit together, or ``strobe_markers``, their slots.
        """
        given = {"title": tool_id, **members}
        body = {name: value for name, value in given.items() if value is not None}
        body |= {"id": tool_id, "device": device_id, "seconds": seconds}
        return send(Tool, "POST", "tool-captures", body=body, extra_timeout_s=seconds)

    @ClientMethod
    def delete_tool(self, tool_id: str) -> Exchange[None]:
        """Delete a tool."""
        return delete("tools", tool_id)

    @ClientMethod
    def tool_pose(self, tool_id: str, frame: str | None = None) -> Exchange[Pose]:
        """The newest pose of a tool, in its reference's frame or another."""
        return get(Pose, "tools", tool_id, "pose", frame=frame)

    @ClientMethod
    def calibrate_pivot(
        self, tool_id: str, seconds: float = 10.0, *, apply: bool = True
    ) -> Exchange[ToolCalibration]:
        """Find a tool's tip from its poses of the next seconds, while it pivots about a point."""
        return _calibrate(tool_id, "pivot-calibrations", seconds, apply=apply)

    @ClientMethod
    def calibrate_spin(
        self, tool_id: str, seconds: float = 10.0, *, apply: bool = True
    ) -> Exchange[ToolCalibration]:
        """Find a tool's axis from its poses of the next seconds, while it spins about it."""
        return _calibrate(tool_id, "spin-calibrations", seconds, apply=apply)

    @ClientMethod
    def measure_point(
        self,
        /,
        tool_id: str,
        *,
        frame: str | None = None,
        name: str | None = None,
        timeout_s: float = 30.0,
        **members: Any,
    ) -> Exchange[MeasuredPoint]:
        """Measure a point with a tool's tip, as soon as it is held still.

        The result can be a measured position of ``register``.

        Args:
            tool_id: the tool.
            frame: ``tracker``, a tool, or a registration; None: the tool's reference.
            name: of the point, for the answer.
            timeout_s: longest time to wait for the tip to be still [s].
            members: others of the body of POST /api/v1/tools/ID/points.
        """
        body = {**members, "frame": frame, "name": name, "timeout_s": timeout_s}
        path = ("tools", tool_id, "points")
        return send(MeasuredPoint, "POST", *path, body=body, extra_timeout_s=timeout_s)


def _calibrate(
    tool_id: str, resource: str, seconds: float, *, apply: bool
) -> Exchange[ToolCalibration]:
    body = {"seconds": seconds, "apply": apply}
    path = ("tools", tool_id, resource)
    return send(ToolCalibration, "POST", *path, body=body, extra_timeout_s=seconds)
