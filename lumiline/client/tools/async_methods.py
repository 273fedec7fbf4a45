"""AsyncClient's methods for tools, their calibration, and points measured with them."""

from collections.abc import Sequence
from typing import Any

from lumiline.client.async_connection import AsyncConnection
from lumiline.client.response_model import Vector3
from lumiline.client.tools import models as d
from lumiline.client.tools import requests


class AsyncToolMethods(AsyncConnection):
    """Tools, their calibration, and points measured with them, with asyncio."""

    async def tools(self, device_id: str | None = None) -> list[d.Tool]:
        """Tools, of a device."""
        return await self._all(requests.tools(device_id))

    async def tool(self, tool_id: str) -> d.Tool:
        """One tool."""
        return await self._one(requests.tool(tool_id))

    async def create_tool(
        self, tool_id: str, device_id: str, markers_mm: Sequence[Vector3], **members: Any
    ) -> d.Tool:
        """Make a tool of known geometry; ``members`` as in the body of POST /api/v1/tools."""
        return await self._one(requests.create_tool(tool_id, device_id, markers_mm, members))

    async def capture_tool(
        self, tool_id: str, device_id: str, *, seconds: float = 1.0, **members: Any
    ) -> d.Tool:
        """Make a tool by showing it, held still, to a running device.

        Args:
            tool_id: the id that it gets.
            device_id: the device.
            seconds: how long it is looked at [s].
            members: others of the body of POST /api/v1/tool-captures, such as ``markers``, how many
                are lit together, or ``strobe_markers``, their slots.
        """
        return await self._one(requests.capture_tool(tool_id, device_id, seconds, members), seconds)

    async def delete_tool(self, tool_id: str) -> None:
        """Delete a tool."""
        await self.request("DELETE", requests.tool(tool_id).path)

    async def tool_pose(self, tool_id: str, frame: str | None = None) -> d.Pose:
        """The newest pose of a tool, in its reference's frame or another."""
        return await self._one(requests.tool_pose(tool_id, frame))

    async def calibrate_pivot(
        self, tool_id: str, seconds: float = 10.0, *, apply: bool = True
    ) -> d.ToolCalibration:
        """Find a tool's tip, from its poses of the next seconds about a fixed point."""
        call = requests.calibrate_tool(tool_id, "pivot", seconds, apply=apply)
        return await self._one(call, seconds)

    async def calibrate_spin(
        self, tool_id: str, seconds: float = 10.0, *, apply: bool = True
    ) -> d.ToolCalibration:
        """Find a tool's axis, from its poses of the next seconds about it."""
        call = requests.calibrate_tool(tool_id, "spin", seconds, apply=apply)
        return await self._one(call, seconds)

    async def measure_point(
        self,
        tool_id: str,
        *,
        frame: str | None = None,
        name: str | None = None,
        timeout_s: float = 30.0,
        **members: Any,
    ) -> d.MeasuredPoint:
        """Wait until a tool's tip is held still; return where, to be ``measured`` in ``register``.

        Args:
            tool_id: the tool.
            frame: ``tracker``, a tool, or a registration; None: the tool's reference.
            name: of the point, for the answer.
            timeout_s: how long is waited [s].
            members: others of the body of POST /api/v1/tools/ID/points.
        """
        call = requests.measure_point(tool_id, frame, name, timeout_s, members)
        return await self._one(call, timeout_s)
