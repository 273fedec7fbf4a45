"""Activation while a device runs at 1 kHz: between two frames, and none is lost."""

import json
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import httpx
import numpy as np
import pytest
from websockets.sync.client import connect

from service.api.calibrations.examples import NEW_CALIBRATIONS
from service.api.correction_tables.hdf5_file import write_table
from service.api.correction_tables.table_content import MEDIA_TYPE
from service.pipeline.frame_processor import MAX_FRAMES
from service.pipeline.pipeline_manager import RING_SECONDS
from tests.running_server import serving
from tests.service.api.correction_tables.tables import content

if TYPE_CHECKING:
    from pathlib import Path

RATE_HZ = 1000
SHIFT_MM = 40.0
SOURCE = {
    "kind": "simulated",
    "settings": {
        "scene": {"kind": "still-points", "points_mm": [[10.0, 20.0, 1500.0]]},
        "frame_rate_hz": RATE_HZ,
    },
}


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    folder: Path = tmp_path_factory.mktemp("activation")
    with serving(folder) as url:
        yield url


@pytest.fixture(scope="module")
def device(server: str) -> str:
    """A running device with three ways to reconstruct: nominal, shifted, shifted with a table."""
    with httpx.Client(base_url=server, timeout=60.0) as client:
        client.post("/api/v1/devices/sim/stop")
        made = {"id": "still", "title": "Still", "source": SOURCE}
        assert client.post("/api/v1/devices", json=made).status_code == 201
        points = NEW_CALIBRATIONS["frame"]["value"]["points"]
        for name, shift in (("plain", 0.0), ("shifted", SHIFT_MM)):
            moved = [
                point | {"position_mm": [point["position_mm"][0] + shift,
                                         *point["position_mm"][1:]]}
                for point in points
            ]  # fmt: skip
            body = {"id": name, "device_id": "still", "points": moved}
            calibration = client.post("/api/v1/calibrations", json=body)
            assert calibration.status_code == 201, calibration.text
        zero = {"coefficients_px": np.full((4, 8, 7, 6), 3.0)}
        table = replace(content(calibration.json()["content_hash"], **zero), device="still")
        sent = client.post(
            "/api/v1/correction-tables?id=map",
            content=write_table(table),
            headers={"content-type": MEDIA_TYPE},
        )
        assert sent.status_code == 201, sent.text
        assert client.post("/api/v1/calibrations/plain/activate").status_code == 200
        assert client.post("/api/v1/devices/still/start").status_code == 200
    return "still"


def wait_for_more(frames: list[dict[str, Any]]) -> None:
    wanted = len(frames) + 150
    end = time.monotonic() + 240.0
    while len(frames) < wanted:
        assert time.monotonic() < end, "the stream stands still"
        time.sleep(0.01)


@pytest.mark.slow
def test_the_stream_switches_between_two_frames_and_loses_none(server: str, device: str):
    frames: list[dict[str, Any]] = []
    missed: list[dict[str, Any]] = []
    done = threading.Event()
    url = (
        server.replace("http", "ws")
        + f"/api/v1/stream?device_id={device}&content=points&encoding=json"
    )

    def listen() -> None:
        with connect(url, max_size=None, compression=None) as stream:
            ready.set()
            while not done.is_set():
                try:
                    message = json.loads(stream.recv(timeout=1.0))
                except TimeoutError:
                    continue
                if message["type"] == "frame":
                    frames.append(message)
                elif message["type"] == "missed":
                    missed.append(message)

    ready = threading.Event()
    listener = threading.Thread(target=listen)
    listener.start()
    assert ready.wait(240.0)
    steps = [
        ("calibrations/shifted/activate", ("shifted", None)),
        ("correction-tables/map/activate", ("shifted", "map")),
        ("calibrations/plain/activate", ("plain", None)),
        ("devices/still/roll-back", ("shifted", "map")),
        ("correction-tables/map/deactivate", ("shifted", None)),
        ("calibrations/plain/activate", ("plain", None)),
    ]
    with httpx.Client(base_url=server, timeout=60.0) as client:
        before = client.get(f"/api/v1/devices/{device}/state").json()
        for path, _ in steps:
            wait_for_more(frames)
            answer = client.post(f"/api/v1/{path}")
            assert answer.status_code == 200, answer.text
        wait_for_more(frames)
        after = client.get(f"/api/v1/devices/{device}/state").json()
    done.set()
    listener.join(240.0)
    assert missed == []
    assert after["frames_dropped_compute"] == before["frames_dropped_compute"]
    sequences = [frame["sequence"] for frame in frames]
    # A slow machine simulates too few exposures: the device says so in the frame that follows.
    for place in np.flatnonzero(np.diff(sequences) != 1).tolist():
        assert sequences[place + 1] > sequences[place]
        assert "overflow" in frames[place + 1]["flags"]
    # Nothing of what the device delivered is missing: it is processed, or waits in the ring.
    assert (
        after["frames_received"] - after["frames_processed"] <= RING_SECONDS * RATE_HZ + MAX_FRAMES
    )
    used = [(frame["calibration_id"], frame["table_id"]) for frame in frames]
    runs = [one for place, one in enumerate(used) if place == 0 or used[place - 1] != one]
    assert runs == [("plain", None), *(wanted for _, wanted in steps)]
    # Every frame was reconstructed by what it names: none half by the old and half by the new.
    places: dict[Any, list[float]] = {}
    for frame, name in zip(frames, used, strict=True):
        [point] = frame["points"]
        places.setdefault(name, []).append(point["position_mm"][0])
    plain, shifted = (np.array(places[name, None]) for name in ("plain", "shifted"))
    corrected = np.array(places["shifted", "map"])
    assert np.abs(plain - 10.0).max() < 3.0
    assert np.abs(shifted - 10.0 - SHIFT_MM).max() < 3.0
    spread = shifted.std() + corrected.std()
    assert abs(corrected.mean() - shifted.mean()) > 2.0 * spread


@pytest.mark.slow
def test_a_target_is_captured_from_the_running_device(server: str, device: str):
    with httpx.Client(base_url=server, timeout=60.0) as client:
        body = {
            "id": "live",
            "device_id": device,
            "targets": [{"name": "one", "position_mm": [10.0, 20.0, 1500.0]}],
            "settings": {"frames": 100, "marker": 0},
        }
        assert client.post("/api/v1/captures", json=body).status_code == 201
        found = client.post("/api/v1/captures/live/capture").json()
        [target] = found["captured"]
        assert (target["frames"], found["left"]) == (100, 0)
        assert len(target["sensors"]) == 4
        for sensor in target["sensors"]:
            assert sensor["frames"] == 100
            # The peaks' own deviations are honest: the spread is what they state.
            assert sensor["spread_px"] == pytest.approx(sensor["stated_px"], rel=0.5)
        by_mean = {one["sensor"]: one["mean_px"] for one in target["sensors"]}
        points = [{"name": "one", "readings": by_mean}]
        made = client.post("/api/v1/reconstructions", json={"device_id": device, "points": points})
        [estimate] = made.json()["estimates"]
        assert np.allclose(estimate["position_mm"], [10.0, 20.0, 1500.0], atol=1.0)
        wrong = body | {"id": "wrong", "settings": {"frames": 10, "marker": 5, "timeout_s": 0.5}}
        client.post("/api/v1/captures", json=wrong)
        refused = client.post("/api/v1/captures/wrong/capture").json()
        assert refused["type"] == "/problems/nothing-seen"
        assert "0 of 10 frames with marker 5" in refused["detail"]
