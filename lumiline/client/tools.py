"""Requests about tools, their calibration, and points measured with them."""

from collections.abc import Sequence
from typing import Any

from lumiline.client.exchange import ClientMethod, Exchanges, float_rows
from lumiline.client.models import MeasuredPoint, Pose, Tool, ToolCalibration, Vector3


class ToolMethods(Exchanges):
    """Requests about tools, their calibration, and points measured with them."""

    @ClientMethod
    async def tools(self, device_id: str | None = None) -> list[Tool]:
        """Tools, of one device."""
        return await self._get_all(Tool, "tools", device=device_id)

    @ClientMethod
    async def tool(self, tool_id: str) -> Tool:
        """One tool."""
        return await self._get(Tool, "tools", tool_id)

    @ClientMethod
    async def create_tool(
        self, /, tool_id: str, device_id: str, markers_mm: Sequence[Vector3], **members: Any
    ) -> Tool:
        """Make a tool of known geometry; ``members`` as in the body of POST /api/v1/tools."""
        body = {
            "title": tool_id,
            **members,
            "id": tool_id,
            "device": device_id,
            "markers_mm": float_rows(markers_mm),
        }
        return await self._send(Tool, "POST", "tools", body=body)

    @ClientMethod
    async def capture_tool(
        self, /, tool_id: str, device_id: str, *, seconds: float = 1.0, **members: Any
    ) -> Tool:
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
        return await self._send(Tool, "POST", "tool-captures", body=body, extra_timeout_s=seconds)

    @ClientMethod
    async def delete_tool(self, tool_id: str) -> None:
        """Delete a tool."""
        await self._delete("tools", tool_id)

    @ClientMethod
    async def tool_pose(self, tool_id: str, frame: str | None = None) -> Pose:
        """The newest pose of a tool, in its reference's frame or another."""
        return await self._get(Pose, "tools", tool_id, "pose", frame=frame)

    async def _calibrate(
        self, tool_id: str, resource: str, seconds: float, *, apply: bool
    ) -> ToolCalibration:
        body = {"seconds": seconds, "apply": apply}
        path = ("tools", tool_id, resource)
        return await self._send(ToolCalibration, "POST", *path, body=body, extra_timeout_s=seconds)

    @ClientMethod
    async def calibrate_pivot(
        self, tool_id: str, seconds: float = 10.0, *, apply: bool = True
    ) -> ToolCalibration:
        """Find a tool's tip from its poses of the next seconds, while it pivots about a point."""
        return await self._calibrate(tool_id, "pivot-calibrations", seconds, apply=apply)

    @ClientMethod
    async def calibrate_spin(
        self, tool_id: str, seconds: float = 10.0, *, apply: bool = True
    ) -> ToolCalibration:
        """Find a tool's axis from its poses of the next seconds, while it spins about it."""
        return await self._calibrate(tool_id, "spin-calibrations", seconds, apply=apply)

    @ClientMethod
    async def measure_point(
        self,
        /,
        tool_id: str,
        *,
        frame: str | None = None,
        name: str | None = None,
        timeout_s: float = 30.0,
        **members: Any,
    ) -> MeasuredPoint:
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
        return await self._send(MeasuredPoint, "POST", *path, body=body, extra_timeout_s=timeout_s)
