"""Fused devices over REST: their sensors, what is refused, and one that runs."""

import time
from typing import Any

import httpx
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from compute.camera.stack import CameraStack
from hardware.simulated.simulated_rig import simulated_sensor_models
from tests.service.protocols.stream.test_stream import receive, streaming

SENSORS = ("vertical", "horizontal", "diagonal-rising", "diagonal-falling")
PLACEMENTS: dict[str, dict[str, Any]] = {
    "left": {"position_mm": [0.0, 0.0, -1500.0]},
    "right": {
        "position_mm": [1500.0, 0.0, 0.0],
        "rotation_rad": [0.0, -np.pi / 2.0, 0.0],
        "delay_ms": 3.7,
    },
}
"""Both bars look at the hall's origin, from the front and from the side."""
MARKERS = [[0.0, 0.0, 0.0], [80.0, 0.0, 0.0], [0.0, 60.0, 0.0], [20.0, 15.0, 40.0]]
TOOL = {"markers_mm": MARKERS, "centre_mm": [0.0, 0.0, 0.0], "swing_mm": [80.0, 60.0, 60.0]}


def bar(name: str) -> dict[str, Any]:
    """A simulated bar in a hall with a tool."""
    settings = {
        "scene": {"kind": "moving-tools", "tools": [{**TOOL, "period_s": 20.0}]},
        "frame_rate_hz": 100.0,
        "placement": PLACEMENTS[name],
        "seed": len(name),
    }
    source = {"kind": "simulated", "settings": settings}
    return {"id": name, "title": name, "source": source}


def hall(bars: list[str], **settings: Any) -> dict[str, Any]:
    source = {"kind": "fusion", "bars": bars, "settings": settings}
    return {"id": "hall", "title": "Hall", "source": source}


def control_points() -> list[dict[str, Any]]:
    """Points that both bars see, as their sensors read them."""
    points = np.random.default_rng(2).uniform(-250.0, 250.0, (40, 3))
    cameras = CameraStack.of(simulated_sensor_models())
    readings: dict[str, np.ndarray] = {}
    for name, placement in PLACEMENTS.items():
        turned = Rotation.from_rotvec(placement.get("rotation_rad", [0.0, 0.0, 0.0]))
        seen = cameras.project(turned.inv().apply(points - np.array(placement["position_mm"])))
        readings |= {f"{name}.{sensor}": seen[:, n] for n, sensor in enumerate(SENSORS)}
    return [
        {
            "name": f"P{n}",
            "position_mm": point.tolist(),
            "readings": {name: round(float(read[n]), 3) for name, read in readings.items()},
        }
        for n, point in enumerate(points)
    ]


def test_its_sensors_are_those_of_its_bars(sqlite_client: Any) -> None:
    for name in PLACEMENTS:
        assert sqlite_client.post("/api/v1/devices", json=bar(name)).status_code == 201
    made = sqlite_client.post("/api/v1/devices", json=hall(["left", "right"], max_wait_ms=20))
    assert made.status_code == 201, made.text
    names = [sensor["name"] for sensor in made.json()["sensors"]]
    assert names == [f"{name}.{sensor}" for name in PLACEMENTS for sensor in SENSORS]
    assert made.json()["source"]["settings"] == {"max_wait_ms": 20, "clock_uncertainty_us": 50}
    again = sqlite_client.post("/api/v1/devices", json={**hall(["hall", "left"]), "id": "building"})
    assert again.status_code == 422
    assert "is fused itself" in again.json()["detail"]


@pytest.mark.parametrize(
    ("bars", "status", "problem"),
    [
        (["left", "nowhere"], 404, "unknown-device"),
        (["left", "left"], 422, "invalid-parameter"),
        (["left"], 422, "invalid-request"),
        (["left", "hall"], 404, "unknown-device"),
    ],
)
def test_what_cannot_be_is_refused(
    sqlite_client: Any, bars: list[str], status: int, problem: str
) -> None:
    assert sqlite_client.post("/api/v1/devices", json=bar("left")).status_code == 201
    answer = sqlite_client.post("/api/v1/devices", json=hall(bars))
    assert (answer.status_code, answer.json()["type"]) == (status, f"/problems/{problem}")


def sent(method: str, url: str, **options: Any) -> Any:
    answer = httpx.request(method, url, timeout=240.0, **options)
    assert answer.is_success, answer.text
    return answer.json() if answer.content else None


def wait_for_state(api: str, state: str, text: str) -> None:
    """Wait until the hall is so; machines may be busy."""
    end = time.monotonic() + 120.0
    while True:
        now = sent("GET", f"{api}/devices/hall/state")
        if now["state"] == state and text in (now["reason"] or ""):
            return
        assert time.monotonic() < end, now
        time.sleep(0.1)


def next_frame(socket: Any, wanted: Any) -> dict[str, Any]:
    """Return the first frame that is wanted."""
    end = time.monotonic() + 120.0
    while True:
        assert time.monotonic() < end, "it did not come"
        message: dict[str, Any] = receive(socket)
        if message["type"] == "frame" and wanted(message):
            return message


def of_sensors(count: int) -> Any:
    return lambda frame: any(len(point["sensors"]) == count for point in frame["points"])


def check_recording(api: str, recordings: str) -> None:
    """Points of a recording are those that were made, worked out again too."""
    made = sent("POST", recordings, json={"id": "hall.h5", "contents": ["results"]})
    end = time.monotonic() + 120.0
    while sent("GET", f"{api}/recordings/hall.h5")["frames_written"] < 50:
        assert time.monotonic() < end, made
        time.sleep(0.1)
    sent("POST", f"{api}/recordings/hall.h5/stop")
    url = f"{api}/recordings/hall.h5/frames?count=20"
    recorded, again = (
        [frame["points"] for frame in sent("GET", asked)["frames"]]
        for asked in (url, f"{url}&calibration_id=joint")
    )
    assert sum(map(len, recorded)) > 0
    for points, others in zip(recorded, again, strict=True):
        assert [one["position_mm"] for one in points] == [one["position_mm"] for one in others]


@pytest.mark.slow
def test_a_hall_of_two_bars(server: str) -> None:
    """Calibrated together, started, streamed; a bar goes and comes."""
    api = f"{server}/api/v1"
    for name in PLACEMENTS:
        sent("POST", f"{api}/devices", json=bar(name))
    # On a busy machine a bar's frames may be late by as much.
    sent("POST", f"{api}/devices", json=hall(["left", "right"], max_wait_ms=500))
    calibration = {"id": "joint", "device_id": "hall", "points": control_points()}
    sent("POST", f"{api}/calibrations", json=calibration)
    sent("POST", f"{api}/calibrations/joint/activate")
    tool = {"id": "pointer", "device_id": "hall", "title": "Pointer", "markers_mm": MARKERS}
    sent("POST", f"{api}/tools", json={**tool, "strobe_markers": [0, 1, 2, 3]})
    state = sent("POST", f"{api}/devices/hall/start")
    assert state["state"] == "disconnected"
    assert '"left" is away: it was not started' in state["reason"]
    for name in PLACEMENTS:
        sent("POST", f"{api}/devices/{name}/start")
    wait_for_state(api, "running", "")
    with streaming(server, "device_id=hall&content=points,tools,tracks") as socket:
        together = next_frame(socket, of_sensors(8))
        (point,) = together["points"]
        assert np.linalg.norm(point["position_mm"]) < 300.0
        assert np.sqrt(np.trace(point["covariance_mm2"])) < 1.0
        found = next_frame(
            socket, lambda frame: any(tool["status"] == "OK" for tool in frame["tools"])
        )
        assert found["tools"][0]["tool_id"] == "pointer"
        sent("POST", f"{api}/devices/right/stop")
        wait_for_state(api, "running", '"right" is away: it is stopped')
        next_frame(socket, of_sensors(4))
        sent("POST", f"{api}/devices/right/start")
        next_frame(socket, of_sensors(8))
        wait_for_state(api, "running", "")
    recordings = f"{api}/devices/hall/recordings"
    refused = httpx.post(recordings, json={"contents": ["lines"]}, timeout=60.0)
    assert (refused.status_code, refused.json()["type"]) == (422, "/problems/invalid-parameter")
    assert "has no scans" in refused.json()["detail"]
    scans = httpx.get(f"{api}/devices/hall/scans", timeout=60.0)
    assert (scans.status_code, scans.json()["type"]) == (422, "/problems/invalid-parameter")
    check_recording(api, recordings)
    for name in ("hall", *PLACEMENTS):
        sent("POST", f"{api}/devices/{name}/stop")
