"""The server as part of the service: settings, tools of the database, metrics, the audit log."""

import socket
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from service.application.app import create_app
from service.protocols.openigtlink.bodies import Command, read_command, write_command
from service.protocols.openigtlink.message import Decoder, Message, write_message
from service.settings import Settings
from tests.service.fake_pipeline import FakePipeline, TestClient
from tests.service.protocols.openigtlink.readers import read_points, read_status
from tests.service.protocols.openigtlink.test_client import Everything, entry, pose


class Socket:
    """A client that blocks."""

    def __init__(self, address: tuple[str, int]) -> None:
        self._socket = socket.create_connection(address, timeout=60.0)
        self._decoder = Decoder(Everything())

    def send(self, message: Message) -> None:
        self._socket.sendall(write_message(message))

    def of(self, kind: str) -> Message:
        while True:
            found = self._decoder.take()
            if found is None:
                data = self._socket.recv(65536)
                assert data
                self._decoder.feed(data)
            elif isinstance(found, Message) and found.type == kind:
                return found

    def command(self, name: str, text: str = "") -> str:
        self.send(Message("COMMAND", "", write_command(Command(1, name, text))))
        return read_command(self.of("RTS_COMMAND").content).text

    def close(self) -> None:
        self._socket.close()


def running(folder: Path, **settings: Any) -> Iterator[tuple[TestClient, FakePipeline, Socket]]:
    live = FakePipeline()
    app = create_app(Settings(data_dir=folder, openigtlink_port=0, **settings), live)
    with TestClient(app) as client:
        found = Socket(app.state.openigtlink.address)
        try:
            yield client, live, found
        finally:
            found.close()


@pytest.fixture
def service(tmp_path: Path) -> Iterator[tuple[TestClient, FakePipeline, Socket]]:
    yield from running(tmp_path)


@pytest.fixture
def open_service(tmp_path: Path) -> Iterator[tuple[TestClient, FakePipeline, Socket]]:
    yield from running(tmp_path, openigtlink_changes=True)


MARKERS = [[0.0, 0.0, 0.0], [60.0, 0.0, 0.0], [0.0, 45.0, 0.0], [10.0, 12.0, 30.0]]


def test_tools_of_the_database_are_sent(service: tuple[TestClient, FakePipeline, Socket]):
    client, live, wire = service
    others = [[1.3 * value for value in marker] for marker in MARKERS]
    for body in (
        {"id": "ref", "markers_mm": others},
        {"id": "probe", "markers_mm": MARKERS, "reference_id": "ref"},
    ):
        body |= {"device_id": "sim", "title": "A tool"}
        answer = client.post("/api/v1/tools", json=body)
        assert answer.status_code == 201, answer.text
    server = client.app.state.openigtlink  # type: ignore[attr-defined]
    while set(server.named("sim").names) != {"probe", "ref"}:
        live.poses.put(entry(1))  # in which are tools that the server does not know yet
        time.sleep(0.01)
    live.poses.put(entry(2))
    assert {wire.of("TRANSFORM").device for _ in range(2)} == {"probeToRef", "refToTracker"}
    wire.send(Message("GET_POINT", "probe"))
    points = read_points(wire.of("POINT").content)
    assert [point.name for point in points][: len(MARKERS)] == [
        f"probe marker {number}" for number in range(len(MARKERS))
    ]
    assert {point.owner for point in points} == {"Ref"}
    text = client.get("/metrics").text
    assert "lumiline_openigtlink_clients 1.0" in text
    assert 'lumiline_openigtlink_messages_received_total{type="GET_POINT"} 1.0' in text
    assert "lumiline_openigtlink_frames_sent_total" in text


@pytest.mark.slow
def test_limits_of_the_database_hold_relative_to_the_reference(
    service: tuple[TestClient, FakePipeline, Socket],
):
    client, live, wire = service
    others = [[1.3 * value for value in marker] for marker in MARKERS]
    for body in (
        {"id": "ref", "markers_mm": others},
        {"id": "probe", "markers_mm": MARKERS, "reference_id": "ref", "limits": {"tip_sd_mm": 0.6}},
    ):
        answer = client.post("/api/v1/tools", json=body | {"device_id": "sim", "title": "A tool"})
        assert answer.status_code == 201, answer.text
    here = {"covariance": np.diag([0.0] * 3 + [0.1] * 3), "tip_mm": pose("probe").translation_mm}
    server = client.app.state.openigtlink  # type: ignore[attr-defined]
    while set(server.named("sim").names) != {"probe", "ref"}:
        live.poses.put(entry(1, [pose(tool, **here) for tool in ("probe", "ref")]))
        time.sleep(0.01)
    live.poses.put(entry(2, [pose(tool, **here) for tool in ("probe", "ref")]))
    told = wire.of("STATUS")
    while told.device != "probeToRef":
        told = wire.of("STATUS")
    status = read_status(told.content)
    assert status.name == "HIGH_ERROR"
    assert status.text.endswith("in this frame is 0.775 mm; 0.6 mm is the most")


def test_landmarks_know_what_they_were_measured_with(
    service: tuple[TestClient, FakePipeline, Socket],
):
    client, live, wire = service
    points = [[0, 0, 0], [100, 0, 0], [0, 100, 0], [0, 0, 100]]
    pairs = [{"name": str(n), "frame_mm": one, "measured_mm": one} for n, one in enumerate(points)]
    answer = client.post(
        "/api/v1/registrations", json={"id": "ct", "device_id": "sim", "fiducials": pairs}
    )
    assert answer.status_code == 201, answer.text
    for number, (in_force, count) in enumerate(
        ((("sim-nominal", None), 4), (("other", None), 0), (("sim-nominal", "map"), 0))
    ):
        live.poses.put(entry(number, [pose("probe", number)], in_force=in_force))
        server = client.app.state.openigtlink  # type: ignore[attr-defined]
        while server._newest is None or server._newest.entry.sequence != number:
            time.sleep(0.01)
        wire.send(Message("GET_POINT", "Landmarks"))
        assert len(read_points(wire.of("POINT").content)) == count


def test_changes_are_refused_and_audited_once_a_minute(
    service: tuple[TestClient, FakePipeline, Socket],
):
    client, live, wire = service
    live.poses.put(entry(1, [pose("probe", 1)]))
    for _ in range(3):
        assert "openigtlink_changes" in wire.command("StartRecording")
    found = client.get("/api/v1/audit", params={"operation": "openigtlink-start-recording"}).json()
    (one,) = found["items"]
    assert one["outcome"] == "refused"
    assert one["actor"] == {
        "kind": "service", "id": "openigtlink", "name": "OpenIGTLink client",
    }  # fmt: skip
    assert one["address"] == "127.0.0.1"


def test_changes_that_are_allowed_are_audited(
    open_service: tuple[TestClient, FakePipeline, Socket],
):
    client, _, wire = open_service
    identity = " ".join(str(value) for value in np.eye(4).ravel())
    text = f'<Command TransformName="aToB" TransformValue="{identity}"/>'
    assert "SUCCESS" in wire.command("UpdateTransform", text)
    # The live side of this test runs nothing that could be recorded.
    told = wire.command("StartRecording", '<Command CaptureDeviceId="sim"/>')
    assert "does not run" in told
    assert "not being recorded" in wire.command("StopRecording", '<Command ChannelId="sim"/>')
    found = client.get("/api/v1/audit", params={"object_kind": "openigtlink"}).json()["items"]
    assert [(one["operation"], one["outcome"]) for one in found] == [
        ("openigtlink-stop-recording", "refused"),
        ("openigtlink-start-recording", "refused"),
        ("openigtlink-set-transform", "done"),
    ]


def test_without_a_port_there_is_no_server(tmp_path: Path):
    app = create_app(Settings(data_dir=tmp_path), FakePipeline())
    with TestClient(app) as client:
        assert not hasattr(app.state, "openigtlink")
        assert "openigtlink" not in client.get("/metrics").text


def test_a_port_that_is_taken_keeps_the_service_from_starting(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        app = create_app(Settings(data_dir=tmp_path, openigtlink_port=port), FakePipeline())
        with pytest.raises(OSError, match=str(port)), TestClient(app):
            pass
    assert f"port {port}" in caplog.text


@pytest.mark.parametrize(
    "wrong",
    [
        {"openigtlink_host": "0.0.0.0"},
        {"openigtlink_host": "192.168.1.5"},
        {"openigtlink_allow": ("0.0.0.0/0",)},
        {"openigtlink_allow": ("or-1.hospital",)},
        {"openigtlink_port": 70_000},
        {"openigtlink_rate_hz": 0.0},
    ],
)
def test_settings_that_mean_harm(tmp_path: Path, wrong: dict[str, Any]):
    with pytest.raises(ValidationError, match="openigtlink"):
        Settings(data_dir=tmp_path, **wrong)


def test_another_address_needs_an_allow_list(tmp_path: Path):
    settings = Settings(
        data_dir=tmp_path, openigtlink_host="0.0.0.0", openigtlink_allow=("10.0.0.0/24",)
    )
    assert settings.openigtlink_allow == ("10.0.0.0/24",)
