"""A real server tracks a tool: made, streamed, pivoted and deleted while the device runs."""

import json
import time
from typing import Any

import httpx
import numpy as np
import pytest
from typer.testing import CliRunner

from hardware.simulated.scenes import MovingTool, MovingTools
from service.cli import app
from tests.service.protocols.stream.test_stream import receive, streaming

MARKERS = ((0.0, 0.0, 0.0), (80.0, 0.0, 0.0), (0.0, 60.0, 0.0), (20.0, 15.0, 40.0))
TIP = (-100.0, 0.0, 0.0)
PIVOTED = MovingTool(MARKERS, swing_mm=(0.0, 0.0, 0.0), held_mm=TIP, period_s=8.0)
SCENE = {
    "kind": "moving-tools",
    "tools": [
        {"markers_mm": MARKERS, "swing_mm": [0, 0, 0], "held_mm": TIP, "period_s": 8.0},
    ],
}
TOOL = {
    "id": "pointer",
    "device_id": "sim",
    "title": "Pointer",
    "markers_mm": MARKERS,
    "strobe_markers": [0, 1, 2, 3],
}


def sent(method: str, url: str, **options: Any) -> Any:
    headers = {"If-Match": "*"} if method == "PATCH" else None
    answer = httpx.request(method, url, timeout=60.0, headers=headers, **options)
    assert answer.is_success, answer.text
    return answer.json() if answer.content else None


@pytest.fixture(autouse=True)
def shown(server: str) -> None:
    """The device shows a pointer that is pivoted about its tip."""
    settings = {"scene": SCENE, "frame_rate_hz": 200}
    source = {"kind": "simulated", "settings": settings}
    # A marker is seen every 20 ms: that the tool is turned slowly makes its pose known well.
    tracking = {
        "tracks": "with-tools",
        "tool_acceleration_mm_s2": 500,
        "tool_angular_acceleration_rad_s2": 5,
    }
    changed = {"source": source, "tracking": tracking}
    sent("PATCH", f"{server}/api/v1/devices/sim", json=changed)
    sent("POST", f"{server}/api/v1/devices/sim/start")


def next_frame(socket: Any, wanted: Any) -> dict[str, Any]:
    """Return the first frame that is wanted."""
    end = time.monotonic() + 240.0
    while True:
        assert time.monotonic() < end, "it did not come"
        message: dict[str, Any] = receive(socket)
        if message["type"] == "frame" and wanted(message):
            return message


def tip_is_held(tool: dict[str, Any]) -> bool:
    """Whether the tip is where the scene holds it, and not at the tool's origin, 100 mm away."""
    found = tool["tip_mm"]
    return found is not None and bool(np.linalg.norm(np.subtract(found, PIVOTED.centre_mm)) < 5.0)


@pytest.mark.slow
def test_a_tool_from_rest_to_the_stream(server: str):
    api = f"{server}/api/v1"
    assert PIVOTED.markers_mm == MARKERS
    with streaming(server, "device_id=sim&content=tools,tracks") as socket:
        hello = receive(socket)
        assert hello["content"] == ["tools", "tracks"]
        assert next_frame(socket, lambda _: True)["tools"] == []
        sent("POST", f"{api}/tools", json=TOOL)
        frame = next_frame(socket, lambda one: one["tools"] and one["tools"][0]["status"] == "OK")
        assert (frame["tools"][0]["tool_id"], frame["calibration_id"]) == ("pointer", "sim-nominal")
        # The truth at that instant: the device's clock is the scene's.
        rotation, origin = MovingTools((PIVOTED,)).pose(0, frame["device_ns"] * 1e-9)
        np.testing.assert_allclose(frame["tools"][0]["translation_mm"], origin, atol=5.0)
        np.testing.assert_allclose(frame["tools"][0]["rotation"], rotation, atol=0.05)
        assert next_frame(socket, lambda one: one["tracks"])["tracks"][0]["id"] >= 1
        pose = sent("GET", f"{api}/tools/pointer/pose")
        assert pose["sequence"] > frame["sequence"]
        assert pose["frame_id"] == "tracker"
        answer = sent("POST", f"{api}/tools/pointer/pivot-calibrations", json={"duration_s": 2.5})
        error = np.linalg.norm(np.subtract(answer["tip_mm"], TIP))
        assert error < 1.0, answer
        assert answer["applied"]
        next_frame(socket, lambda one: tip_is_held(one["tools"][0]))
        sent("DELETE", f"{api}/tools/pointer")
        next_frame(socket, lambda one: one["tools"] == [])
    status = sent("GET", f"{api}/devices/sim/state")
    assert status["state"] == "running"
    metrics = httpx.get(f"{server}/metrics").text
    assert 'lumiline_tool_frames_total{device="sim",tool="pointer"' not in metrics


def lumiline(server: str, *arguments: str, code: int | None = 0) -> str:
    given = ["tools", *arguments, "--url", server]
    run = CliRunner().invoke(app, given, env={"COLUMNS": "120"})
    assert code is None or run.exit_code == code, run.output
    return run.output


@pytest.mark.slow
def test_tools_on_the_command_line(server: str):
    assert "there are no tools" in lumiline(server, "watch", code=2)
    sent("POST", f"{server}/api/v1/tools", json=TOOL | {"tip_mm": TIP})
    listed = lumiline(server, "list")
    assert "Pointer" in listed
    assert "0 1 2 3" in listed
    assert [tool["id"] for tool in json.loads(lumiline(server, "list", "--json"))] == ["pointer"]
    end = time.monotonic() + 240.0
    while '"OK"' not in (text := lumiline(server, "show", "pointer", "--json", code=None)):
        assert time.monotonic() < end
        time.sleep(0.05)
    tip = json.loads(text)["pose"]["tip_mm"]
    assert np.linalg.norm(np.subtract(tip, PIVOTED.centre_mm)) < 5.0
    assert "pointer" in lumiline(server, "show", "pointer", code=None)
    assert "pointer" in lumiline(server, "watch", "--seconds", "0.3")
    refused = lumiline(server, "show", "nothing", code=2)
    assert 'no tool "nothing"' in " ".join(refused.split())
    sent("POST", f"{server}/api/v1/devices/sim/stop")
    stopped = lumiline(server, "show", "pointer", code=1)
    assert "is stopped" in stopped
    sent("DELETE", f"{server}/api/v1/tools/pointer")
    assert "refused" in lumiline("http://127.0.0.1:9", "list", code=2)
