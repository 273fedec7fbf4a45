"""Resources of a real server, through both clients."""

import asyncio
import time
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from compute.camera.stack import CameraStack
from hardware.simulated.simulated_rig import simulated_rig
from lumiline.client import AsyncClient, Client, ServerProblem, ServerUnreachable, UnreadableMessage
from lumiline.client import models as d
from lumiline.client.fiducials import paired_points
from lumiline.client.server import Server

MARKERS = [(0.0, 0.0, 0.0), (80.0, 0.0, 0.0), (0.0, 60.0, 0.0), (40.0, 30.0, 50.0)]

Ask = Callable[..., Any]


@pytest.fixture(params=["sync", "async"])
def ask(request: pytest.FixtureRequest, server: str) -> Ask:
    """Ask the server by the one client or the other."""

    def waiting(name: str, *args: Any, **named: Any) -> Any:
        with Client(server) as client:
            return getattr(client, name)(*args, **named)

    def together(name: str, *args: Any, **named: Any) -> Any:
        async def run() -> Any:
            async with AsyncClient(server) as client:
                return await getattr(client, name)(*args, **named)

        return asyncio.run(run())

    return waiting if request.param == "sync" else together


@pytest.mark.slow
def test_devices_and_calibrations(ask: Ask) -> None:
    device = ask("device", "sim")
    assert [one.id for one in ask("devices")] == ["sim"]
    assert (device.id, device.active_calibration_id) == ("sim", "sim-nominal")
    assert len(device.sensors) == 4
    assert device.created_at.utcoffset() == timedelta(0)
    assert ask("device_state", "sim").calibration_id == "sim-nominal"
    found = ask("calibrations", device_id="sim", state="active")
    assert [one.id for one in found] == ["sim-nominal"]
    assert ask("calibration", "sim-nominal").content_hash == found[0].content_hash
    assert ask("activate_calibration", "sim-nominal", expected="sim-nominal").state == "active"


def test_a_refusal_has_its_code_and_its_reason(ask: Ask) -> None:
    with pytest.raises(ServerProblem) as caught:
        ask("device", "nobody")
    assert (caught.value.status, caught.value.code) == (404, "unknown-device")
    assert "nobody" in caught.value.detail
    assert "nobody" in str(caught.value)
    with pytest.raises(ServerProblem) as caught:
        ask("request", "POST", "/api/v1/reconstructions", body={"device_id": "sim", "points": []})
    assert caught.value.code == "invalid-request"
    assert caught.value.errors[0]["location"] == ["body", "points"]
    with pytest.raises(ServerProblem, match="409 "):
        ask("roll_back_device", "sim", expected="another")


def test_points_from_readings(ask: Ask) -> None:
    models = [sensor.model for sensor in simulated_rig()]
    place = np.array([[30.0, -20.0, 1500.0]])
    readings = CameraStack.of(models).project(place)[0]
    given = {
        model.name: {"position_px": value, "sigma_px": 0.05}  # as NumPy has it
        for model, value in zip(models, readings, strict=True)
    }
    points = [
        {"name": "a", "readings": given},
        {"name": "b", "readings": {models[0].name: 1000.0}},
    ]
    found = ask("create_reconstruction", device_id="sim", points=points)
    first, second = found.estimates
    assert first.position_mm == pytest.approx(tuple(place[0]), abs=0.01)
    assert len(first.covariance_mm2) == 3
    assert second.position_mm is None
    assert "too-few-sensors" in second.flags


def test_a_list_of_many_pages_is_read_whole(ask: Ask, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lumiline.client.exchange.PAGE_SIZE", 2)
    point = {"name": "a", "readings": {simulated_rig()[0].model.name: 1000.0}}
    for _ in range(5):
        ask("create_reconstruction", device_id="sim", points=[point])
    found = ask("reconstructions", device_id="sim")
    assert len(found) >= 5
    assert ask("reconstructions", limit=3) == found[:3]
    assert len({one.id for one in found}) == len(found)


def test_a_tool_from_its_making_to_its_end(ask: Ask) -> None:
    made = ask(
        "create_tool", id="probe", device_id="sim", title="Probe", markers_mm=np.array(MARKERS),
        tip_mm=[0.0, 0.0, 150.0],
    )  # fmt: skip
    try:
        assert made.markers_mm == tuple(MARKERS)
        assert made.tip.position_mm == (0.0, 0.0, 150.0)
        assert [one.id for one in ask("tools", device_id="sim")] == ["probe"]
        assert ask("tool", "probe") == made
        pose = ask("tool_pose", "probe")
        # The rotating bar has no such tool: there is a reason, and no pose.
        assert (pose.tool_id, pose.frame_id) == ("probe", "tracker")
        assert pose.status != "OK"
        assert pose.reason
        assert pose.rotation is None
    finally:
        ask("delete_tool", "probe")
    assert ask("tools", device_id="sim") == []


def test_a_registration_tells_its_errors(ask: Ask) -> None:
    places = np.array([[0, 0, 0], [100, 0, 0], [0, 80, 0], [30, 20, 60.0]])
    turned = places @ np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]]).T + [5, 6, 700]
    pairs = {str(one): (a, b) for one, (a, b) in enumerate(zip(places, turned, strict=True))}
    found = ask(
        "create_registration", id="ct", device_id="sim", fiducials=paired_points(pairs),
        targets=[{"name": "tumour", "frame_mm": (30.0, 30.0, 30.0)}], measured_sigma_mm=0.3,
    )  # fmt: skip
    try:
        assert np.allclose(np.array(found.matrix)[:3, 3], [5, 6, 700], atol=1e-6)
        assert found.fre_mm < 1e-6
        assert 0.1 < found.targets[0].error_mm < 0.6
        assert ask("registration", "ct").id == "ct"
        assert [one.id for one in ask("registrations")] == ["ct"]
    finally:
        ask("delete_registration", "ct")


def test_frames_of_markers_and_surfaces(ask: Ask) -> None:
    markers = [(10.0, -20.0, 1500.0), (110.0, -20.0, 1500.0), (10.0, 60.0, 1500.0)]
    # A box without symmetry, and sixteen places on three of its sides.
    corners = [(x, y, z) for z in (-120, 0) for y in (-100, 100) for x in (-70, 70)]
    sides = [(0, 1, 3), (0, 3, 2), (4, 5, 7), (4, 7, 6), (0, 1, 5), (0, 5, 4),
             (2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 3, 7), (1, 7, 5)]  # fmt: skip
    on = np.array([(x, y, 0) for x in (-50, 50) for y in (-80, 20, 80)]
                  + [(-70, y, z) for y in (-80, 0, 80) for z in (-20, -90)]
                  + [(x, 100, z) for x in (-50, 50) for z in (-20, -90)])  # fmt: skip
    three = {"kind": "three-markers", "device_id": "sim", "measured_sigma_mm": 0.05}
    mesh = {"kind": "mesh", "vertices_mm": corners, "triangles": sides}
    try:
        plate = ask("create_registration", id="plate", measured_mm=markers, **three)
        assert (plate.kind, plate.fre_mm) == ("three-markers", None)
        assert [one.name for one in plate.markers] == ["M1", "M2", "M3"]
        assert plate.matrix[0][3] == pytest.approx(10.0)
        moved = on + np.array(markers[0]) + [0.5, -0.3, 0.2]
        found = ask(
            "create_registration", kind="surface", id="box", device_id="sim", parent_id="plate",
            points_mm=moved, surface=mesh, trim=0.0,
        )  # fmt: skip
        assert (found.kind, found.parent_id) == ("surface", "plate")
        assert np.allclose(np.array(found.matrix)[:3, 3], [10.5, -20.3, 1500.2], atol=1e-3)
        assert found.surface is not None
        assert found.surface.rms_mm < 1e-3
        assert len(found.surface.distance_mm) == len(on)
        frames = {one.id: one for one in ask("frames", "sim").frames}
        assert frames["box"].connected
        assert frames["box"].root_frame_id == frames["plate"].root_frame_id == "tracker"
        between = ask("frame_transform", "sim", "box", to_frame_id="plate")
        assert between.path_frame_ids == ("box", "tracker", "plate")
        assert np.allclose(np.array(between.matrix)[:3, 3], [0.5, -0.3, 0.2], atol=1e-3)
        line = [(0.0, 0.0, 0.0), (50.0, 0.0, 0.0), (90.0, 0.0, 0.0)]
        with pytest.raises(ServerProblem, match="collinear-points"):
            ask("create_registration", id="line", measured_mm=line, **three)
    finally:
        for name in ("plate", "box"):
            ask("delete_registration", name)


@pytest.mark.slow
def test_a_recording_from_its_begin_to_a_file(ask: Ask, tmp_path: Path) -> None:
    begun = ask("start_recording", "sim", max_duration_s=3000.0)
    with pytest.raises(ServerProblem, match="recording-in-progress"):
        ask("download_recording", begun.id, tmp_path / "early.h5")
    ended = ask("stop_recording", begun.id)
    assert begun.id in [one.id for one in ask("recordings", device_id="sim")]
    assert (ended.id, ended.state) == (begun.id, "complete")
    file = ask("download_recording", begun.id, tmp_path / "bench.h5")
    assert file.stat().st_size == ask("recording", begun.id).size_bytes
    assert file.read_bytes()[:8] == b"\x89HDF\r\n\x1a\n"
    assert ask("download_recording", begun.id, str(file)) == file
    # Neither of a refused download nor of a complete one is a part left.
    assert [one.name for one in tmp_path.iterdir()] == ["bench.h5"]
    ask("delete_recording", begun.id)


@pytest.fixture(scope="module")
def exported(server: str) -> d.Run:
    """A run that has exported a recording, in a process of the server's."""
    with Client(server) as client:
        begun = client.start_recording("sim", id="walk.h5", max_duration_s=3000.0)
        client.stop_recording(begun.id)
        run = client.create_export_run(
            recording_id="walk.h5", device_id="sim", format="csv", result_id="walk"
        )
        assert run.state in ("queued", "running")
        return client.wait_for_run(run.id)


@pytest.mark.slow
def test_an_export_from_its_run_to_a_file(ask: Ask, exported: d.Run, tmp_path: Path) -> None:
    assert (exported.state, exported.result_id) == ("succeeded", "walk"), exported.problem
    assert ask("wait_for_run", exported.id) == exported
    found = ask("export", "walk")
    assert (found.run_id, found.recording_id, found.format) == (exported.id, "walk.h5", "csv")
    assert found in ask("exports")
    file = ask("download_export", "walk", tmp_path / "walk.csv")
    assert file.stat().st_size == found.size_bytes
    assert file.read_text().startswith("frame,sequence,")
    with pytest.raises(ServerProblem, match="unknown-export"):
        ask("download_export", "none", tmp_path / "none.csv")
    assert [one.name for one in tmp_path.iterdir()] == ["walk.csv"]
    other = ask(
        "create_export_run", recording_id="walk.h5", device_id="sim", format="trc", tool_ids=[]
    )
    assert ask("cancel_run", other.id).state == "cancelled"
    assert ask("wait_for_run", other.id, timeout_s=0.0).state == "cancelled"
    with pytest.raises(ServerProblem, match="unknown-export"):
        ask("delete_export", other.id)


def test_stop_and_start(ask: Ask) -> None:
    assert ask("stop_device", "sim").state == "stopped"
    assert ask("start_device", "sim").state in {"starting", "running"}
    end = time.monotonic() + 240.0
    while ask("device_state", "sim").state != "running":
        assert time.monotonic() < end
        time.sleep(0.02)


def test_what_is_no_lumiline_document_is_told(ask: Ask) -> None:
    with pytest.raises(UnreadableMessage, match="JSON"):
        ask("request", "GET", "/metrics")


def test_a_server_that_is_not_there() -> None:
    with Client("http://127.0.0.1:9", timeout_s=5.0) as client, pytest.raises(ServerUnreachable):
        client.devices()


@pytest.mark.parametrize(
    "url", ["localhost:8000", "ftp://a", "http://", "http://u:p@host", "http://a?b"]
)
def test_an_address_that_is_none(url: str) -> None:
    with pytest.raises(ValueError, match="server"):
        Client(url)


def test_a_key_is_shown_nowhere() -> None:
    server = Server("http://a/lumi/", "lumi_secret", "subprotocol")
    assert "lumi_secret" not in repr(server)
    assert server.stream_url == "ws://a/lumi/api/v1/stream"
    assert server.stream_subprotocols == ["lumiline.v1", "lumiline.bearer.lumi_secret"]
    assert server.stream_headers == {}


def test_a_client_is_shown_with_its_address_and_without_its_key() -> None:
    assert repr(Client("http://a/lumi/")) == "Client('http://a/lumi', key=None)"
    assert repr(AsyncClient("http://a", "lumi_secret")) == "AsyncClient('http://a', key=***)"


def test_an_unreachable_server_is_named() -> None:
    with (
        Client("http://127.0.0.1:9", timeout_s=5.0) as client,
        pytest.raises(ServerUnreachable, match=r"http://127\.0\.0\.1:9 did not answer GET /api/v1"),
    ):
        client.devices()


def test_times_of_a_query_and_of_answers_are_datetimes(ask: Ask) -> None:
    begin = datetime.now(UTC) - timedelta(seconds=5)
    ask("change_device", "sim", title="Simulated")
    entries = ask("audit", operation="change-device", since=begin, limit=5)
    assert all(entry.created_at >= begin for entry in entries)
    assert len(entries) >= 1
    assert ask("audit", since=datetime.now(UTC) + timedelta(days=1)) == []


def test_answer_of_a_newer_server_keeps_its_further_members(ask: Ask) -> None:
    answer = ask("request", "GET", "/api/v1/devices/sim", params={"ignored": None})
    device = d.Device.model_validate({**answer, "weather": "fine"})
    assert device.model_extra == {"weather": "fine"}


def test_metrics_and_pictures_are_answered_as_they_are(ask: Ask, tmp_path: Path) -> None:
    assert "# TYPE lumiline_" in ask("metrics")
    picture = ask("quality_picture", "sim", tmp_path / "quality.png")
    assert picture.read_bytes()[:4] == b"\x89PNG"


def test_a_correction_table_that_is_none_is_refused_by_the_server(ask: Ask, tmp_path: Path) -> None:
    file = tmp_path / "table.h5"
    file.write_bytes(b"no table")
    with pytest.raises(ServerProblem) as caught:
        ask("upload_correction_table", file, id="mine")
    assert 400 <= caught.value.status < 500
    assert ask("correction_tables", device_id="sim") == []
