"""Sensors that change: no calibration of other sensors is stored, activated or used."""

import json
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from compute.errors import InvalidParameter
from service.api.calibrations import router as calibrations
from service.api.devices.schema import Sensor, sensors_match
from service.database.models import DeviceRow
from tests.service.fake_pipeline import FakePipeline

EXAMPLES = Path(__file__).parents[4] / "docs" / "examples"


def example(name: str) -> Any:
    return json.loads((EXAMPLES / f"{name}.json").read_text())


DEVICE = example("device")
CALIBRATION = example("calibration") | {"distortion": "none", "labels": "off"}  # done sooner
SENSORS = DEVICE["source"]["sensors"]
REVERSED = {"kind": "external", "sensors": SENSORS[::-1]}
ONE_LONGER = {"kind": "external", "sensors": [SENSORS[0] | {"pixels": 481}, *SENSORS[1:]]}


def during_the_run(monkeypatch: pytest.MonkeyPatch, act: Callable[[], Any]) -> None:
    """Act between the reading of the sensors and the storing of the calibration."""
    run = calibrations.run_calibration

    def and_act(*given: Any) -> Any:
        outcome = run(*given)
        act()
        return outcome

    monkeypatch.setattr(calibrations, "run_calibration", and_act)


@pytest.mark.parametrize("source", [REVERSED, ONE_LONGER])
def test_sensors_changed_during_the_run_are_a_conflict_and_nothing_is_stored(
    client: Any, monkeypatch: pytest.MonkeyPatch, source: Any
):
    client.post("/api/v1/devices", json=DEVICE)
    path = f"/api/v1/devices/{DEVICE['id']}"
    answers: list[Any] = []
    during_the_run(monkeypatch, lambda: answers.append(client.patch(path, json={"source": source})))
    refused = client.post("/api/v1/calibrations", json=CALIBRATION)
    assert [answer.status_code for answer in answers] == [200]
    assert (refused.status_code, refused.json()["type"]) == (409, "/problems/sensors-changed")
    assert "calibrate the sensors that the device has now" in refused.json()["detail"]
    assert client.get(f"/api/v1/calibrations?device_id={DEVICE['id']}").json()["items"] == []


def test_a_title_changed_during_the_run_is_none(client: Any, monkeypatch: pytest.MonkeyPatch):
    client.post("/api/v1/devices", json=DEVICE)
    path = f"/api/v1/devices/{DEVICE['id']}"
    during_the_run(monkeypatch, lambda: client.patch(path, json={"title": "New"}))
    assert client.post("/api/v1/calibrations", json=CALIBRATION).status_code == 201


def calibrated(client: Any) -> str:
    """Make the example's device and its calibration, active; return the calibration's id."""
    client.post("/api/v1/devices", json=DEVICE)
    made = client.post("/api/v1/calibrations", json=CALIBRATION)
    assert made.status_code == 201
    assert client.post(f"/api/v1/calibrations/{made.json()['id']}/activate").status_code == 200
    return str(made.json()["id"])


def exchange_sensors(client: Any) -> None:
    """Reverse the sensors in the database, past all checks."""
    with client.app.state.database.write() as session:
        row = session.get_one(DeviceRow, DEVICE["id"])
        row.sensors = row.sensors[::-1]


def test_a_calibration_of_other_sensors_is_not_activated(client: Any, live: FakePipeline):
    first = calibrated(client)
    second = client.post("/api/v1/calibrations", json=CALIBRATION | {"id": "second"}).json()["id"]
    exchange_sensors(client)
    live.calls.clear()
    refused = client.post(f"/api/v1/calibrations/{second}/activate")
    assert (refused.status_code, refused.json()["type"]) == (409, "/problems/sensors-changed")
    assert client.get(f"/api/v1/devices/{DEVICE['id']}").json()["active_calibration_id"] == first
    assert live.calls == []


def test_a_calibration_of_other_sensors_reconstructs_nothing(client: Any):
    calibrated(client)
    body = example("reconstruction")
    assert client.post("/api/v1/reconstructions", json=body).status_code == 201
    exchange_sensors(client)
    refused = client.post("/api/v1/reconstructions", json=body | {"id": "again"})
    assert (refused.status_code, refused.json()["type"]) == (409, "/problems/sensors-changed")
    assert len(client.get("/api/v1/reconstructions").json()["items"]) == 1


def test_sensors_of_a_running_device_change_when_it_was_stopped(client: Any, live: FakePipeline):
    body = {"id": DEVICE["id"], "title": "Bar", "source": {"kind": "simulated"}}
    path = f"/api/v1/devices/{client.post('/api/v1/devices', json=body).json()['id']}"
    client.post(f"{path}/start")
    refused = client.patch(path, json={"source": DEVICE["source"]})
    assert (refused.status_code, refused.json()["type"]) == (409, "/problems/device-running")
    assert client.get(path).json()["source"]["kind"] == "simulated"
    faster = {"kind": "simulated", "settings": {"frame_rate_hz": 2000}}
    assert client.patch(path, json={"source": faster}).status_code == 200
    client.post(f"{path}/stop")
    assert client.patch(path, json={"source": DEVICE["source"]}).status_code == 200


def test_an_activation_that_the_running_device_cannot_take_is_answered_as_committed(
    client: Any,
    live: FakePipeline,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
):
    def refuse(*_: Any) -> None:
        raise InvalidParameter("of other sensors")

    monkeypatch.setattr(live, "set_calibration", refuse)
    with caplog.at_level(logging.ERROR):
        made = calibrated(client)
    assert client.get(f"/api/v1/devices/{DEVICE['id']}").json()["active_calibration_id"] == made
    assert f"does not use {made} yet" in caplog.text


def test_sensors_are_the_same_by_names_pixels_and_order():
    a, b = Sensor("a", 512, 14.0), Sensor("b", 512, 14.0)
    assert sensors_match([a, b], [a, Sensor("b", 512, 7.0)])
    assert not sensors_match([a, b], [b, a])
    assert not sensors_match([a, b], [a])
    assert not sensors_match([a], [Sensor("a", 513, 14.0)])
