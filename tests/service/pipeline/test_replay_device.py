"""A recording as a device of a real server: created, calibrated, started, streamed to its end."""

import json
from pathlib import Path
from typing import Any

import httpx
import pytest
from websockets.sync.client import connect

from hardware.recording.writer import RecordingWriter
from hardware.simulated.driver import SimulatedDriver
from hardware.simulated.settings import SimulationSettings
from tests.running_server import serving


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """A data directory whose recordings hold half a second of the bar."""
    path = tmp_path / "recordings" / "bar.h5"
    path.parent.mkdir()
    driver = SimulatedDriver(
        "sim", SimulationSettings(realtime=False, duration_s=0.5, frame_rate_hz=200)
    )
    driver.open()
    with RecordingWriter(path, driver.description) as writer:
        for frame in driver.frames():
            writer.append(frame)
    return tmp_path


def test_replay_device(recording: Path) -> None:
    with serving(recording) as url, httpx.Client(base_url=f"{url}/api/v1", timeout=60.0) as api:
        source = {"kind": "replay", "recording_id": "bar.h5", "speed": 2.0}
        body = {"id": "tape", "title": "The bar again", "source": source}
        device = api.post("/devices", json=body)
        assert device.status_code == 201, device.text
        names = [sensor["name"] for sensor in device.json()["sensors"]]
        assert len(names) == 4
        websocket = url.replace("http", "ws", 1) + "/api/v1/stream?device_id=tape&encoding=json"
        with connect(f"{websocket}&content=peaks", compression=None) as stream:
            messages: list[dict[str, Any]] = [json.loads(stream.recv(timeout=240.0))]
            assert messages[0]["state"] == "stopped"
            api.post("/devices/tape/start").raise_for_status()
            while messages[-1].get("state") != "ended":
                messages.append(json.loads(stream.recv(timeout=240.0)))
        frames = [message for message in messages if message["type"] == "frame"]
        assert [frame["sequence"] for frame in frames] == list(range(100))
        assert all({peak["sensor"] for peak in f["peaks"]} == set(names) for f in frames)
        status = api.get("/devices/tape/state").json()
        assert (status["state"], status["frames_received"]) == ("ended", 100)
