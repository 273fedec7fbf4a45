"""Types of both clients' methods, for mypy: `make lint` checks this file, nothing runs it.

An unused `type: ignore` is an error, so each of them shows that a wrong call is found.
"""

from pathlib import Path
from typing import Any, assert_type

from lumiline.client import AsyncClient, Client
from lumiline.client.messages import Frame, Message
from lumiline.client.models import Device, MeasuredPoint, Pose, Run, Tool
from lumiline.client.stream import AsyncStream, Stream


def blocking(client: Client) -> None:
    """Methods return their results."""
    assert_type(client.devices(), list[Device])
    assert_type(client.tool_pose("probe", frame_id="ct"), Pose)
    assert_type(client.measure_point("probe", duration_s=0.1), MeasuredPoint)
    assert_type(client.download_export("walk", "walk.csv"), Path)
    assert_type(client.wait_for_run("run", timeout_s=1.0), Run)
    assert_type(client.request("GET", "/api/v1/devices"), Any)
    assert_type(client.stream("sim"), Stream)
    for message in client.stream("sim", ["peaks"], mode="lossless"):
        assert_type(message, Message)
    client.tool_pose("probe", marker="ct")  # type: ignore[call-arg]
    client.device(3)  # type: ignore[arg-type]
    client.device()  # type: ignore[call-arg]
    client.stream("sim", ["light"])  # type: ignore[list-item]
    client.weather()  # type: ignore[attr-defined]
    tool = client.create_tool(id="a", device_id="sim", title="A", markers_mm=[(0, 0, 0), [1, 0, 0]])
    assert_type(tool, Tool)
    assert_type(client.delete_tool("a"), None)
    client.create_tool(id="a", device_id="sim", title="A")  # type: ignore[call-arg]
    client.create_tool(id="a", device_id="sim", title="A", markers_mm="abc")  # type: ignore[arg-type]
    client.change_tool("a", colour="red")  # type: ignore[call-arg]
    client.create_tool(
        id="a",
        device_id="sim",
        title="A",
        markers_mm=[(0, 0, 0)],
        limits={"tip_sd": 1.0},  # type: ignore[typeddict-unknown-key]
    )


async def awaitable(client: AsyncClient) -> None:
    """Methods are coroutine functions."""
    assert_type(await client.devices(), list[Device])
    assert_type(await client.tool_pose("probe", frame_id="ct"), Pose)
    assert_type(await client.measure_point("probe", duration_s=0.1), MeasuredPoint)
    assert_type(await client.download_export("walk", "walk.csv"), Path)
    assert_type(await client.request("GET", "/api/v1/devices"), Any)
    assert_type(client.stream("sim"), AsyncStream)
    async for frame in client.stream("sim").frames():
        assert_type(frame, Frame)
    client.devices()  # type: ignore[unused-coroutine]
    await client.tool_pose("probe", marker="ct")  # type: ignore[call-arg]
    await client.device(3)  # type: ignore[arg-type]
