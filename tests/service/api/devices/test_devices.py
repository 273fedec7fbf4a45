"""Devices: created, changed, deleted, started, on both databases."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from hardware.driver import DeviceDescription, SensorDescription
from hardware.recording.writer import RecordingWriter
from hardware.simulated.driver import SimulatedDriver
from service.api.devices.store import get_device
from service.jobs.store import add_run, cancel
from service.settings import Settings

EXTERNAL = {
    "id": "bar",
    "title": "Bar",
    "source": {
        "kind": "external",
        "sensors": [{"name": name, "pixels": 1024, "pitch_um": 7.5} for name in "ABC"],
    },
}


def test_a_fresh_server_has_the_simulated_device_running_and_calibrated(client: Any, live: Any):
    device = client.get("/api/v1/devices/sim").json()
    assert device["source"]["kind"] == "simulated"
    assert device["source"]["settings"]["scene"]["kind"] == "rotating-bar"
    assert device["autostart"] is True
    assert device["active_calibration_id"] == "sim-nominal"
    assert len(device["sensors"]) == 4
    name, device_id, calibration_id, calibration = live.calls[0]
    assert (name, device_id, calibration_id) == ("start", "sim", "sim-nominal")
    assert [model.name for model in calibration.models] == [
        sensor["name"] for sensor in device["sensors"]
    ]


def test_an_external_device_has_the_sensors_given(client: Any):
    made = client.post("/api/v1/devices", json=EXTERNAL)
    assert made.status_code == 201
    assert made.headers["location"] == "/api/v1/devices/bar"
    read = client.get(made.headers["location"]).json()
    assert read == made.json()
    assert read["sensors"] == EXTERNAL["source"]["sensors"]
    assert read["active_calibration_id"] is None
    assert [item["id"] for item in client.get("/api/v1/devices").json()["items"]] == ["bar", "sim"]


def test_a_simulated_device_has_its_drivers_sensors(client: Any):
    body = {"id": "second", "title": "Second", "source": {"kind": "simulated"}}
    made = client.post("/api/v1/devices", json=body).json()
    assert made["sensors"] == client.get("/api/v1/devices/sim").json()["sensors"]


def test_an_id_is_unique(client: Any):
    again = client.post("/api/v1/devices", json=EXTERNAL | {"id": "sim"})
    assert again.status_code == 409
    assert again.json()["type"] == "/problems/device-exists"


def test_a_change_touches_only_what_is_given(client: Any):
    before = client.get("/api/v1/devices/sim").json()
    after = client.patch("/api/v1/devices/sim", json={"title": "Hall"}).json()
    differing = {key for key in before if before[key] != after[key]}
    assert differing == {"title", "updated_at"}
    assert after["title"] == "Hall"
    assert after["updated_at"] > before["updated_at"]


@pytest.mark.parametrize("field", ["title", "source", "autostart"])
def test_a_change_to_null_is_refused(client: Any, field: str):
    assert client.patch("/api/v1/devices/sim", json={field: None}).status_code == 422


def test_settings_of_the_simulator_change_and_sensors_in_use_do_not(client: Any):
    faster = {"kind": "simulated", "settings": {"frame_rate_hz": 2000}}
    changed = client.patch("/api/v1/devices/sim", json={"source": faster})
    assert changed.json()["source"]["settings"]["frame_rate_hz"] == 2000
    refused = client.patch("/api/v1/devices/sim", json={"source": EXTERNAL["source"]})
    assert refused.status_code == 409
    assert refused.json()["type"] == "/problems/device-in-use"
    assert client.get("/api/v1/devices/sim").json()["source"]["kind"] == "simulated"


def test_a_device_stored_before_lines_were_fitted_keeps_its_method(client: Any):
    settings = client.get("/api/v1/devices/sim").json()["source"]["settings"]
    assert settings.pop("peaks") == "fit"
    with client.app.state.database.write() as session:
        row = get_device(session, "sim")
        row.source = {"kind": "simulated", "settings": settings}
    client.patch("/api/v1/devices/sim", json={"title": "As it was"})
    assert client.get("/api/v1/devices/sim").json()["source"]["settings"]["peaks"] == "centroid"
    changed = {"kind": "simulated", "settings": settings}
    client.patch("/api/v1/devices/sim", json={"source": changed})
    assert client.get("/api/v1/devices/sim").json()["source"]["settings"]["peaks"] == "fit"


def test_start_and_stop(client: Any, live: Any):
    assert client.post("/api/v1/devices/sim/stop").json()["state"] == "stopped"
    started = client.post("/api/v1/devices/sim/start").json()
    assert started["device_id"] == "sim"
    assert started["state"] == "running"
    assert started["calibration_id"] == "sim-nominal"
    assert client.get("/api/v1/devices/sim/state").json() == started
    assert [call[0] for call in live.calls] == ["start", "stop", "start"]


def test_an_external_device_cannot_be_started(client: Any, live: Any):
    client.post("/api/v1/devices", json=EXTERNAL)
    refused = client.post("/api/v1/devices/bar/start")
    assert refused.status_code == 409
    assert refused.json()["type"] == "/problems/device-without-driver"
    assert ("start", "bar") not in [call[:2] for call in live.calls]


def test_deleting_is_refused_while_calibrations_exist_and_cascades_on_request(
    client: Any, live: Any
):
    refused = client.delete("/api/v1/devices/sim")
    assert refused.status_code == 409
    assert "1 calibration" in refused.json()["detail"]
    assert client.delete("/api/v1/devices/sim?cascade=true").status_code == 204
    assert live.calls[-1] == ("forget", "sim")
    assert client.get("/api/v1/devices/sim").status_code == 404
    assert client.get("/api/v1/calibrations").json()["items"] == []


def test_deleting_is_refused_while_captures_or_runs_exist(client: Any):
    client.post("/api/v1/devices", json=EXTERNAL)
    sensors = client.get("/api/v1/devices/bar").json()["sensors"]
    capture = {
        "id": "held",
        "device_id": "bar",
        "targets": [{"name": "P", "position_mm": [0, 0, 0]}],
    }
    assert client.post("/api/v1/captures", json=capture).status_code == 201
    refused = client.delete("/api/v1/devices/bar")
    assert (refused.status_code, refused.json()["type"]) == (409, "/problems/device-in-use")
    assert (
        'device "bar" is referred to by 1 capture ("held"); add ?cascade=true'
        in refused.json()["detail"]
    )
    with client.app.state.database.write() as session:
        for number in range(2):
            add_run(session, "calibration", "bar", {"result_id": None}, 100, f"run-{number}")
            session.flush()
            cancel(session, f"run-{number}")
    refused = client.delete("/api/v1/devices/bar").json()["detail"]
    assert '1 capture ("held"), 2 runs ("run-0", "run-1")' in refused
    # Neither keeps the sensors from being changed.
    source = EXTERNAL["source"] | {"sensors": [sensors[0] | {"pixels": 99}, *sensors[1:]]}
    changed = client.patch("/api/v1/devices/bar", json={"source": source})
    assert changed.status_code == 200, changed.text
    assert client.delete("/api/v1/devices/bar?cascade=true").status_code == 204
    assert client.get("/api/v1/captures").json()["items"] == []
    assert client.get("/api/v1/runs").json()["items"] == []


def test_a_device_without_calibrations_is_deleted(client: Any):
    client.post("/api/v1/devices", json=EXTERNAL)
    assert client.delete("/api/v1/devices/bar").status_code == 204
    assert client.get("/api/v1/devices/bar").status_code == 404


def test_pages(client: Any):
    for number in range(4):
        client.post("/api/v1/devices", json=EXTERNAL | {"id": f"bar-{number}"})
    page = client.get("/api/v1/devices?limit=3").json()
    assert [item["id"] for item in page["items"]] == ["bar-0", "bar-1", "bar-2"]
    last = {"limit": 3, "cursor": page["next_cursor"]}
    page = client.get("/api/v1/devices", params=last).json()
    assert [item["id"] for item in page["items"]] == ["bar-3", "sim"]
    assert page["next_cursor"] is None


def replay(recording: str) -> dict[str, Any]:
    return {
        "id": "again",
        "title": "Again",
        "source": {"kind": "replay", "recording_id": recording},
    }


@pytest.mark.parametrize(
    "recording", ["../outside.h5", "/etc/passwd", "a/../../outside.h5", ".hidden", "a\\..\\b", ""]
)
def test_a_recordings_name_cannot_leave_the_folder(client: Any, recording: str):
    refused = client.post("/api/v1/devices", json=replay(recording))
    assert refused.status_code == 422
    assert refused.json()["type"] == "/problems/invalid-request"


def test_a_link_out_of_the_folder_is_not_followed(client: Any, settings: Settings, tmp_path: Path):
    outside = tmp_path / "outside.h5"
    outside.write_bytes(b"secret")
    (settings.folders.recordings / "link.h5").symlink_to(outside)
    refused = client.post("/api/v1/devices", json=replay("link.h5"))
    assert refused.status_code == 404
    assert refused.json()["type"] == "/problems/unknown-recording"


def test_a_file_that_is_no_recording_is_refused(client: Any, settings: Settings):
    (settings.folders.recordings / "text.h5").write_text("no recording")
    refused = client.post("/api/v1/devices", json=replay("text.h5"))
    assert refused.status_code == 422
    assert refused.json()["type"] == "/problems/invalid-recording"


@pytest.fixture
def record(settings: Settings) -> Callable[..., None]:
    """Writes a recording "odd.h5" of two sensors, its description changed."""

    def write(pixels: int = 16, **changes: Any) -> None:
        sensors = (SensorDescription("a", pixels, 7.0), SensorDescription("b", pixels, 7.0))
        described = DeviceDescription("bar", sensors, 100.0, 12, 12.0, 30.0, 64.0, 0)
        with RecordingWriter(settings.folders.recordings / "odd.h5", replace(described, **changes)):
            pass

    return write


def test_a_recordings_sensors_are_the_devices(client: Any, record: Callable[..., None]):
    record()
    made = client.post("/api/v1/devices", json=replay("odd.h5"))
    assert made.status_code == 201
    assert [sensor["name"] for sensor in made.json()["sensors"]] == ["a", "b"]


@pytest.mark.parametrize(
    "changes",
    [
        {"frame_rate_hz": math.inf},
        {"bits": 99},
        {"sensors": (SensorDescription("", 16, 7.0),)},
        {"sensors": (SensorDescription("a", 16, 0.0),)},
        {"sensors": (SensorDescription("a", 16, 7.0),) * 2},
    ],
)
def test_an_odd_recording_is_refused(
    client: Any, record: Callable[..., None], changes: dict[str, Any]
):
    record(**changes)
    refused = client.post("/api/v1/devices", json=replay("odd.h5"))
    assert (refused.status_code, refused.json()["type"]) == (422, "/problems/invalid-recording")


def test_a_drivers_sensor_that_the_service_cannot_use_is_refused(
    client: Any, record: Callable[..., None]
):
    record(pixels=4)
    refused = client.post("/api/v1/devices", json=replay("odd.h5"))
    assert (refused.status_code, refused.json()["type"]) == (422, "/problems/invalid-parameter")
    assert "sensor 1 of the driver cannot be used: pixels is 4" in refused.json()["detail"]


def test_two_sensors_of_a_driver_may_not_share_a_name(client: Any, monkeypatch: pytest.MonkeyPatch):
    twins = [SensorDescription("a", 16, 7.0)] * 2
    monkeypatch.setattr(SimulatedDriver, "description", SimpleNamespace(sensors=twins))
    body = {"id": "second", "title": "Second", "source": {"kind": "simulated"}}
    refused = client.post("/api/v1/devices", json=body)
    assert (refused.status_code, refused.json()["type"]) == (422, "/problems/invalid-parameter")
    assert 'two sensors are called "a"' in refused.json()["detail"]
