"""The websocket stream of a real server, with a client that we did not write."""

import json
import socket
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import msgpack
import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from tests.running_server import serving


def stream_url(server: str, query: str) -> str:
    return f"{server.replace('http', 'ws', 1)}/api/v1/stream?{query}"


@contextmanager
def streaming(server: str, query: str = "device_id=sim") -> Iterator[ClientConnection]:
    with connect(stream_url(server, query), compression=None, max_queue=None) as websocket:
        yield websocket


def receive(websocket: ClientConnection) -> Any:
    payload = websocket.recv(timeout=240.0)
    return json.loads(payload) if isinstance(payload, str) else msgpack.unpackb(payload)


def without_number(message: dict[str, Any]) -> dict[str, Any]:
    assert isinstance(message["n"], int)
    return {key: value for key, value in message.items() if key != "n"}


def check_sequences(frames: list[dict[str, Any]]) -> None:
    """A machine that stands still simulates too few exposures: the device says so."""
    sequences = np.array([frame["sequence"] for frame in frames])
    steps = np.diff(sequences)
    assert (steps > 0).all()
    assert all("overflow" in frames[index + 1]["flags"] for index in np.flatnonzero(steps != 1))


def status(server: str) -> dict[str, Any]:
    found: dict[str, Any] = httpx.get(f"{server}/api/v1/devices/sim/state").json()
    return found


@pytest.fixture
def query_timeout(tmp_path: Path) -> Iterator[str]:
    """A server whose clients may be a quarter of a second behind."""
    with serving(tmp_path, stream_lag_s=0.25) as url:
        yield url


@pytest.fixture(autouse=True)
def running(server: str) -> None:
    """The device runs with the nominal calibration, at a rate that leaves time for the tests."""
    httpx.post(f"{server}/api/v1/calibrations/sim-nominal/activate").raise_for_status()
    change_source(server, {"frame_rate_hz": 200})


@pytest.mark.slow
def test_greeting_then_frames_without_a_gap(server: str) -> None:
    with streaming(server) as websocket:
        hello = receive(websocket)
        assert hello["type"] == "hello"
        assert hello["device_id"] == "sim"
        assert hello["state"] == "running"
        assert hello["calibration_id"] == "sim-nominal"
        assert len(hello["sensors"]) == 4
        assert (hello["readout"], hello["method"]) == ("lines", "fit")
        frames = [receive(websocket) for _ in range(300)]
    assert [frame["type"] for frame in frames] == ["frame"] * 300
    assert [frame["n"] for frame in frames] == list(range(hello["next"], hello["next"] + 300))
    check_sequences(frames)
    distance = [
        np.linalg.norm(np.subtract(f["points"][0]["position_mm"], [0, 0, 1500])) for f in frames
    ]
    # The bar's ends go round its middle at 146 mm.
    assert np.allclose(distance, 146.0, atol=1.0)
    now = time.time_ns()
    assert all(0 < now - frame["exposure_ns"] < 60e9 for frame in frames)


@pytest.mark.slow
def test_json_on_request_has_the_same_content(server: str) -> None:
    with (
        streaming(server, "device_id=sim&encoding=json&content=points,peaks") as as_json,
        streaming(server, "device_id=sim&content=points,peaks") as as_msgpack,
    ):
        text = {}
        for _ in range(400):
            payload = as_json.recv(timeout=240.0)
            assert isinstance(payload, str)
            message = json.loads(payload)
            text[message.get("sequence")] = message
        for _ in range(400):
            payload = as_msgpack.recv(timeout=240.0)
            assert isinstance(payload, bytes)
            message = msgpack.unpackb(payload)
            if message.get("sequence") in text and message["type"] == "frame":
                assert message == text[message["sequence"]]
                return
    pytest.fail("the two streams have no frame in common")


def test_content_is_what_was_asked_for(server: str) -> None:
    with streaming(server, "device_id=sim&content=peaks") as websocket:
        receive(websocket)
        frame = receive(websocket)
    assert "points" not in frame
    assert {peak["sensor"] for peak in frame["peaks"]} == {
        "vertical", "horizontal", "diagonal-rising", "diagonal-falling",
    }  # fmt: skip
    assert set(frame["peaks"][0]) == {
        "sensor", "position_px", "sigma_px", "amplitude", "width_px", "reduced_chi2", "flags",
    }  # fmt: skip


@pytest.mark.parametrize(
    ("query", "code", "kind", "part"),
    [
        ("device_id=nobody", 404, "unknown-device", "nobody"),
        ("", 422, "invalid-parameter", "device"),
        ("device_id=sim&content=poses", 422, "invalid-parameter", "poses"),
        ("device_id=sim&encoding=xml", 422, "invalid-parameter", "xml"),
        ("device_id=sim&rate=5", 422, "unknown-query-member", "rate_hz"),
        ("device_id=sim&rate_hz=0", 422, "invalid-parameter", '"0"'),
        ("device_id=sim&rate_hz=nan", 422, "invalid-parameter", '"nan"'),
        ("device_id=sim&bundle_ms=5000", 422, "invalid-parameter", "1000 ms"),
        ("device_id=sim&rate_hz=5&bundle_ms=5", 422, "invalid-parameter", "bundle_ms"),
        ("device_id=sim&rate_hz=5&mode=lossless", 422, "invalid-parameter", "lossless"),
        ("device_id=sim&mode=fast", 422, "invalid-parameter", "live or lossless"),
        ("device_id=sim&stream=x&after=3", 422, "invalid-parameter", "mode=lossless"),
        ("device_id=sim&mode=lossless&after=3", 422, "invalid-parameter", "give both"),
        ("device_id=sim&mode=lossless&stream=x&after=-3", 422, "invalid-parameter", '"-3"'),
    ],
)
def test_what_cannot_be_served_is_a_problem_document(
    server: str, query: str, code: int, kind: str, part: str
) -> None:
    with pytest.raises(InvalidStatus) as caught, connect(stream_url(server, query)):
        pass
    response = caught.value.response
    assert response.status_code == code
    assert response.headers["content-type"].startswith("application/problem+json")
    document = json.loads(response.body or b"")
    assert document["type"] == f"/problems/{kind}"
    assert part in document["detail"]


def test_a_stopped_device_says_so_to_its_clients(server: str) -> None:
    with streaming(server) as websocket:
        receive(websocket)
        httpx.post(f"{server}/api/v1/devices/sim/stop").raise_for_status()
        while (message := receive(websocket))["type"] == "frame":
            pass
        assert without_number(message) == {
            "type": "state",
            "device_id": "sim",
            "state": "stopped",
            "reason": None,
            "link": None,
        }
        with streaming(server) as late:
            assert receive(late)["state"] == "stopped"
        httpx.post(f"{server}/api/v1/devices/sim/start").raise_for_status()
        assert receive(websocket)["state"] == "starting"
        assert receive(websocket)["state"] == "running"
        assert receive(websocket)["type"] == "frame"


def test_activation_switches_the_stream_and_loses_no_frame(server: str) -> None:
    nominal = httpx.get(f"{server}/api/v1/calibrations/sim-nominal").json()
    from compute.camera.stack import CameraStack
    from hardware.simulated.simulated_rig import simulated_rig
    from tests.compute.rig import control_points

    models = [sensor.model for sensor in simulated_rig()]
    points = control_points(20)
    readings = CameraStack.of(models).project(points)
    body = {
        "device_id": "sim",
        "points": [
            {
                "name": f"p{index}",
                "position_mm": position.tolist(),
                "readings": {m.name: float(v) for m, v in zip(models, row, strict=True)},
            }
            for index, (position, row) in enumerate(zip(points, readings, strict=True))
        ],
    }
    created = httpx.post(f"{server}/api/v1/calibrations", json=body, timeout=60.0).json()
    with streaming(server) as websocket:
        receive(websocket)
        frames = [receive(websocket) for _ in range(50)]
        httpx.post(f"{server}/api/v1/calibrations/{created['id']}/activate").raise_for_status()
        while frames[-1]["calibration_id"] != created["id"]:
            frames.append(receive(websocket))
            assert len(frames) < 20_000
    check_sequences(frames)
    names = [frame["calibration_id"] for frame in frames]
    assert names == sorted(names, key=lambda name: name != nominal["id"])


@pytest.mark.slow
def test_a_stalled_client_slows_nobody_and_is_told_what_it_missed(query_timeout: str) -> None:
    server = query_timeout
    # 76 peaks a frame make messages of 10 kB: soon more than the sockets' buffers hold.
    change_source(server, {"scene": {"kind": "calibration-frame"}, "frame_rate_hz": 300,
                           "illumination": "simultaneous"})  # fmt: skip
    host, port = server.removeprefix("http://").split(":")
    stalled_socket = socket.create_connection((host, int(port)))
    stalled_socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 65536)
    url = stream_url(server, "device_id=sim&content=points,peaks&encoding=json")
    wanted = 450
    with connect(
        url,
        sock=stalled_socket,
        compression=None,
        max_queue=1,
        ping_interval=None,
        close_timeout=0.2,
    ) as stalled:
        expected = receive(stalled)["next"]
        with streaming(server, "device_id=sim&mode=lossless") as quick:
            receive(quick)
            frames = [receive(quick) for _ in range(wanted)]
        told = 0
        while expected <= frames[-1]["n"]:
            message = receive(stalled)
            # What it is told is what is missing between what it got.
            if message["type"] == "missed":
                assert message["first"] == expected
                expected += message["messages"]
                told += message["messages"]
            else:
                assert message["n"] == expected
                expected += 1
        assert told, "nothing was missed"
    # The other got every frame that was processed meanwhile.
    assert [frame["type"] for frame in frames] == ["frame"] * wanted
    lost = frames[-1]["sequence"] - frames[0]["sequence"] + 1 - wanted
    counters = status(server)
    assert lost <= counters["frames_lost"] + counters["frames_dropped_compute"]


def test_a_lossless_client_that_comes_back_lacks_nothing(server: str) -> None:
    query = "device_id=sim&mode=lossless"
    with streaming(server, query) as websocket:
        hello = receive(websocket)
        assert (hello["mode"], hello["resumed"]) == ("lossless", False)
        first = [receive(websocket) for _ in range(20)]
    numbers = [message["n"] for message in first]
    assert numbers == list(range(hello["next"], hello["next"] + 20))
    time.sleep(0.2)
    again = f"{query}&bundle_ms=20&stream={hello['stream']}&after={numbers[-1]}"
    with streaming(server, again) as websocket:
        back = receive(websocket)
        assert (back["resumed"], back["next"]) == (True, numbers[-1] + 1)
        assert back["stream"] == hello["stream"]
        later = [frame for _ in range(10) for frame in receive(websocket)["frames"]]
    assert len(later) > 40, "those of meanwhile, and more than one a message"
    sequences = [frame["sequence"] for frame in (*first, *later)]
    assert sequences == list(range(sequences[0], sequences[0] + len(sequences)))


def test_at_a_rate_a_client_gets_the_newest(server: str) -> None:
    with streaming(server, "device_id=sim&rate_hz=20&content=peaks") as websocket:
        receive(websocket)
        frames = [receive(websocket) for _ in range(12)]
    assert {frame["type"] for frame in frames} == {"frame"}
    steps = np.diff([frame["sequence"] for frame in frames])
    # 200 frames a second at 20 a second: every tenth, one sooner or later.
    assert 8 <= np.median(steps) <= 12
    assert np.array_equal(steps, np.diff([frame["n"] for frame in frames]))


def test_status_alone_has_no_frames(server: str) -> None:
    with streaming(server, "device_id=sim&content=state&encoding=json") as websocket:
        assert receive(websocket)["content"] == []
        httpx.post(f"{server}/api/v1/devices/sim/stop").raise_for_status()
        assert receive(websocket)["state"] == "stopped"


def change_source(server: str, settings: dict[str, Any]) -> None:
    source = {"kind": "simulated", "settings": settings}
    url = f"{server}/api/v1/devices/sim"
    httpx.patch(url, json={"source": source}, headers={"If-Match": "*"}).raise_for_status()
    httpx.post(f"{url}/start", timeout=60.0).raise_for_status()


def test_a_client_that_left_is_forgotten(server: str) -> None:
    before = status(server)["subscribers"]
    with streaming(server) as websocket:
        receive(websocket)
        assert status(server)["subscribers"] == before + 1
        websocket.send("whatever a client sends is ignored")
        receive(websocket)
    end = time.monotonic() + 240.0
    while status(server)["subscribers"] != before:
        assert time.monotonic() < end
        time.sleep(0.01)


def test_the_stream_ends_when_the_client_closes(server: str) -> None:
    with streaming(server) as websocket:
        receive(websocket)
        websocket.close()
        with pytest.raises(ConnectionClosed):
            deque(iter(lambda: websocket.recv(timeout=240.0), None), maxlen=0)


def test_a_plain_http_request_is_told_to_open_a_websocket(server: str) -> None:
    answer = httpx.get(f"{server}/api/v1/stream?device_id=sim")
    assert answer.status_code == 426
    assert answer.json()["type"] == "/problems/upgrade-required"
    assert "ws://" in answer.json()["detail"]


def test_a_deleted_device_ends_its_streams(server: str) -> None:
    source = {"kind": "simulated", "settings": {"frame_rate_hz": 100}}
    body = {"id": "brief", "title": "Brief", "source": source}
    httpx.post(f"{server}/api/v1/devices", json=body).raise_for_status()
    with streaming(server, "device_id=brief") as websocket:
        hello = receive(websocket)
        assert (hello["state"], hello["sensors"]) == ("stopped", [])
        httpx.post(f"{server}/api/v1/devices/brief/start", timeout=60.0).raise_for_status()
        assert receive(websocket)["state"] == "starting"
        running = receive(websocket)
        assert (running["state"], len(running["sensors"])) == ("running", 4)
        httpx.delete(f"{server}/api/v1/devices/brief").raise_for_status()
        states = []
        with pytest.raises(ConnectionClosed) as closed:
            deque((states.append(m) for m in iter(lambda: receive(websocket), None)), maxlen=0)
    assert closed.value.rcvd is not None
    assert closed.value.rcvd.code == 1001
    assert (states[-1]["type"], states[-1]["state"]) == ("state", "deleted")


def test_an_id_that_cannot_be_one_is_refused(server: str) -> None:
    with pytest.raises(InvalidStatus) as caught, connect(stream_url(server, "device_id=a%00b")):
        pass
    assert caught.value.response.status_code == 422
