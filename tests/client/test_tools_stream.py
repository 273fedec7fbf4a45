"""Tools and tracks of a simulated device: typed in the stream, and the same by request."""

import asyncio
import json
import time
from collections.abc import Iterator
from typing import Any

import httpx
import numpy as np
import pytest
from typer.testing import CliRunner

from lumiline.client import AsyncClient, Client
from lumiline.client.fiducials import paired_points
from lumiline.client.messages import Frame, ToolPose
from lumiline.client.models import MeasuredPoint
from service.cli import app

MARKERS = [[0.0, 0.0, 0.0], [80.0, 0.0, 0.0], [0.0, 60.0, 0.0], [20.0, 15.0, 40.0]]


@pytest.fixture(scope="module")
def tool(server: str) -> Iterator[str]:
    """A tool at rest, and its markers as tracks, of a device of 100 frames a second."""
    url = f"{server}/api/v1"
    scene = {"kind": "moving-tools", "moving": False, "tools": [{"markers_mm": MARKERS}]}
    settings = {"frame_rate_hz": 100, "scene": scene, "illumination": "strobed"}
    asked = {
        "source": {"kind": "simulated", "settings": settings},
        # At rest: 100 frames a second of four markers in turn would leave the tip of a tool that
        # may be moved quickly too unsure to be used.
        "tracking": {
            "tracks": "with-tools",
            "tool_acceleration_mm_s2": 10.0,
            "tool_angular_acceleration_rad_s2": 0.1,
        },
    }
    before = httpx.get(f"{url}/devices/sim").json()
    httpx.patch(f"{url}/devices/sim", json=asked, headers={"If-Match": "*"}).raise_for_status()
    with Client(server) as client:
        client.create_tool(id="probe", device_id="sim", title="Probe", markers_mm=MARKERS,
                           strobe_markers=[0, 1, 2, 3], tip_mm=[0.0, 0.0, 150.0])  # fmt: skip
        client.start_device("sim")
        yield "probe"
        client.delete_tool("probe")
    back = {"source": before["source"], "tracking": before["tracking"]}
    httpx.patch(f"{url}/devices/sim", json=back, headers={"If-Match": "*"}).raise_for_status()
    httpx.post(f"{url}/devices/sim/start", timeout=60.0).raise_for_status()


def test_a_pose_in_the_stream_is_that_of_the_request(server: str, tool: str) -> None:
    end = time.monotonic() + 240.0
    with Client(server) as client, client.stream("sim", ("tools", "tracks")) as stream:
        for frame in stream.frames():
            assert time.monotonic() < end, "there was no pose, and four tracks"
            assert frame.tools is not None
            assert frame.tracks is not None
            if not frame.tools:
                continue
            (streamed,) = frame.tools
            if streamed.valid and len(frame.tracks) == 4:
                break
            assert streamed.valid or streamed.reason
        # Where the machine is busy a pose may be too old to be one; it says so.
        while (asked := client.tool_pose(tool)).status != "OK":
            assert asked.reason
            assert time.monotonic() < end, asked.reason
            time.sleep(0.05)
    check(frame, streamed)
    assert (asked.tool_id, asked.frame_id) == (tool, "tracker")
    # The tool rests: the newest pose is another frame's, of the same place.
    assert asked.translation_mm == pytest.approx(streamed.translation_mm, abs=0.5)
    assert asked.tip_mm == pytest.approx(streamed.tip_mm, abs=1.0)
    assert asked.quaternion_wxyz == pytest.approx(streamed.quaternion_wxyz, abs=0.01)


def check(frame: Frame, pose: ToolPose) -> None:
    rotation, place = np.array(pose.rotation), np.array(pose.translation_mm)
    assert np.allclose(rotation @ rotation.T, np.eye(3))
    assert np.allclose(rotation @ [0.0, 0.0, 150.0] + place, pose.tip_mm)
    assert np.array(pose.covariance).shape == (6, 6)
    assert pose.markers_used >= 3
    # The tracks are the tool's markers, each under its number.
    assert frame.tracks is not None
    found = {track.marker: track for track in frame.tracks}
    assert set(found) == {0, 1, 2, 3}
    for marker, track in found.items():
        assert marker is not None
        wanted = rotation @ MARKERS[marker] + place
        assert np.linalg.norm(np.array(track.position_mm) - wanted) < 2.0
        assert track.state in {"tentative", "confirmed", "coasting"}
        assert np.array(track.covariance_mm2).shape == (3, 3)


def test_a_registration_gives_a_frame_for_poses(server: str, tool: str) -> None:
    places = np.array(MARKERS)
    measured = places + np.array([0.0, 0.0, 1000.0])
    pairs = {str(one): (a, b) for one, (a, b) in enumerate(zip(places, measured, strict=True))}
    with Client(server) as client:
        found = client.create_registration(
            id="plan", device_id="sim", fiducials=paired_points(pairs), measured_sigma_mm=0.1
        )
        try:
            end = time.monotonic() + 240.0
            while True:
                inside, outside = (
                    client.tool_pose(tool, frame_id=one) for one in ("plan", "tracker")
                )
                if inside.translation_mm is not None and outside.translation_mm is not None:
                    break
                assert time.monotonic() < end, inside.reason
                time.sleep(0.05)
        finally:
            client.delete_registration("plan")
    assert found.residual_sigma == pytest.approx(0.0, abs=1e-6)
    assert inside.frame_id == "plan"
    away = np.subtract(outside.translation_mm, inside.translation_mm)
    assert np.allclose(away, [0.0, 0.0, 1000.0], atol=0.5)


def test_a_point_is_measured_and_registered(server: str, tool: str) -> None:
    """The tool of the fixture is at rest, and its tip with it."""
    with Client(server) as client:
        point = measured(client, tool)
        assert (point.name, point.frame_id, point.tool_id) == ("nasion", "tracker", tool)
        assert point.last_ns > point.first_ns
        pose = client.tool_pose(tool)
        while pose.tip_mm is None:
            pose = client.tool_pose(tool)
        assert np.allclose(point.position_mm, pose.tip_mm, atol=2.0)
        beside = {
            name: (place, np.add(point.position_mm, place))
            for name, place in (("a", (90.0, 0.0, 0.0)), ("b", (0.0, 90.0, 0.0)))
        }
        made = client.create_registration(
            id="touched", device_id="sim", measured_sigma_mm=0.1,
            fiducials=paired_points({"nasion": ((0.0, 0.0, 0.0), point), **beside}),
        )  # fmt: skip
        client.delete_registration("touched")
        assert np.allclose(np.array(made.matrix)[:3, 3], point.position_mm, atol=1.0)
        asked = made.request.fiducials[0]
        assert asked.measured_mm == point.position_mm
        assert asked.measured_covariance_mm2 == point.covariance_mm2

        async def the_same() -> MeasuredPoint:
            async with AsyncClient(server) as other:
                return await other.measure_point(tool, **ASKED)

        assert np.allclose(asyncio.run(the_same()).position_mm, point.position_mm, atol=1.0)


def test_a_point_by_the_command_line(server: str, tool: str) -> None:
    words = ["tools", "point", tool, "--url", server, "--timeout-s", "60", "--name", "nasion"]
    words += ["--seconds", "0.1"]
    result = CliRunner().invoke(app, [*words, "--json"])
    assert result.exit_code == 0, result.output
    assert json.loads(result.stdout)["name"] == "nasion"
    with Client(server) as client:
        client.change_tool(tool, tip_mm=None)
        refused = CliRunner().invoke(app, words)
        client.change_tool(tool, tip_mm=[0.0, 0.0, 150.0])
    assert refused.exit_code == 2
    assert "Hold the tip of probe still" in refused.output
    assert "has no tip" in " ".join(refused.output.split())


# A machine that is busy loses frames, and takes its time.
ASKED: dict[str, Any] = {
    "frame_id": "tracker", "name": "nasion", "timeout_s": 60.0, "duration_s": 0.1,
    "max_sigma_mm": 2.0, "max_drift_mm": 2.0,
}  # fmt: skip


def measured(client: Client, tool: str) -> MeasuredPoint:
    return client.measure_point(tool, **ASKED)
