"""Drift checks and update runs: a calibrated device, of which a sensor moves."""

import hashlib
import json
import time
from collections.abc import Iterator
from datetime import UTC, datetime
from typing import Any

import numpy as np
import pytest

from compute.camera.model import SensorModel
from compute.camera.stack import CameraStack
from compute.errors import InvalidParameter
from hardware.simulated.calibration_target import calibration_target_points_mm
from hardware.simulated.simulated_rig import (
    WORKING_CENTRE_MM,
    simulated_rig,
    simulated_sensor_models,
)
from service.api.captures.schema import CapturedSensor, CapturedTarget
from service.api.captures.store import CAPTURES, keep
from service.api.devices.schema import Sensor
from service.api.drift_checks.examples import NEW_DRIFT_CHECKS
from service.api.drift_checks.schema import StationaryMarker
from service.api.drift_checks.stationary_markers import marker_arrays
from service.application.app import create_app
from service.settings import Settings
from tests.compute.rig import turned_about_lens
from tests.service.api.runs.in_process_worker import use_in_process_worker
from tests.service.fake_pipeline import FakePipeline, TestClient

SIGMA_PX = 0.05
PLACES = np.asarray(WORKING_CENTRE_MM) + calibration_target_points_mm()
MODELS = simulated_sensor_models()
NAMES = [model.name for model in MODELS]
MOVED = 2
URL = "/api/v1/calibrations/measured/drift-checks"
NEVER_USED: Any = None


def moved_models() -> tuple[SensorModel, ...]:
    """The device with its third sensor rolled by 3 mrad."""
    models = list(MODELS)
    lens = np.array(simulated_rig()[MOVED].lens_position_mm)
    models[MOVED] = turned_about_lens(models[MOVED], [0.0, 0.0, 3e-3], lens)
    return tuple(models)


def read(models: tuple[SensorModel, ...], places: Any, seed: int) -> list[dict[str, Any]]:
    """What a device reads of markers, with its noise."""
    exact = CameraStack.of(models).project(np.asarray(places))
    noisy = exact + SIGMA_PX * np.random.default_rng(seed).standard_normal(exact.shape)
    return [
        {
            "name": f"P{number + 1}",
            "position_mm": place,
            "readings": {
                name: {"position_px": value, "sigma_px": SIGMA_PX}
                for name, value in zip(NAMES, row, strict=True)
            },
        }
        for number, (place, row) in enumerate(
            zip(np.asarray(places).tolist(), noisy.tolist(), strict=True)
        )
    ]


def bare(points: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The points without their positions."""
    return [{name: point[name] for name in ("name", "readings")} for point in points]


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TestClient]:
    """A server whose simulated device was calibrated, with a check of it before it moved."""
    settings = Settings(data_dir=tmp_path_factory.mktemp("drift"))
    with (
        pytest.MonkeyPatch.context() as patch,
        TestClient(create_app(settings, FakePipeline())) as running,
    ):
        use_in_process_worker(patch)
        body = {"id": "measured", "device_id": "sim", "points": read(MODELS, PLACES, 1)}
        made = running.post("/api/v1/calibrations", json=body)
        assert made.status_code == 201, made.text
        body = {"id": "before", "points": read(MODELS, PLACES[:8], 2)}
        made = running.post(URL, json=body)
        assert made.status_code == 201, made.text
        capture(running, "then", MODELS, 3)
        capture(running, "now", moved_models(), 4)
        yield running


def capture(client: Any, name: str, models: tuple[SensorModel, ...], seed: int) -> None:
    """Store a finished capture session of eight targets."""
    points = read(models, PLACES[:8], seed)
    targets = [{key: point[key] for key in ("name", "position_mm")} for point in points]
    body = {"id": name, "device_id": "sim", "targets": targets}
    assert client.post("/api/v1/captures", json=body).status_code == 201
    with client.app.state.database.write() as session:
        for point in points:
            sensors = [
                CapturedSensor(
                    sensor=sensor,
                    frames=50,
                    mean_px=reading["position_px"],
                    spread_px=SIGMA_PX,
                    stated_px=None,
                    sigma_px=reading["sigma_px"],
                )
                for sensor, reading in point["readings"].items()
            ]
            keep(
                session,
                CAPTURES.get(session, name, lock=True),
                CapturedTarget(
                    target=point["name"], frames=50, sensors=sensors, captured_at=datetime.now(UTC)
                ),
            )


def finished(client: Any, run: str) -> Any:
    end = time.monotonic() + 120.0
    while True:
        found = client.get(f"/api/v1/runs/{run}").json()
        if found["state"] not in ("queued", "running"):
            return found
        assert time.monotonic() < end, found
        time.sleep(0.02)


@pytest.mark.slow
def test_a_device_that_did_not_move_is_good(client: Any):
    found = client.get("/api/v1/drift-checks/before").json()
    assert (found["status"], found["moved"]) == ("good", [])
    assert found["check"]["dof"] == 8 * len(NAMES)
    assert found["calibration_id"] == "measured"
    assert found["in_words"][0].startswith("The calibration holds (32 readings")
    assert found["points"][7]["name"] == "P8"


@pytest.mark.parametrize(
    "given",
    [
        {"points": read(moved_models(), PLACES[:8], 5)},
        {"points": bare(read(moved_models(), PLACES[:8], 6)), "against": "calibration"},
        {"capture_id": "now", "against": "capture", "earlier_capture_id": "then"},
    ],
    ids=["positions", "calibration", "capture"],
)
def test_the_sensor_that_moved_is_named(client: Any, given: dict[str, Any]):
    posted = client.post(URL, json=given)
    assert posted.status_code == 201, posted.text
    found = posted.json()
    assert posted.headers["location"] == f"/api/v1/drift-checks/{found['id']}"
    assert (found["status"], found["moved"]) == ("sensors-moved", [NAMES[MOVED]])
    drift = found["check"]["sensors"][MOVED]
    assert drift["parameter"] == "rotation_z_rad"
    assert abs(drift["change"] - 3e-3) < 5 * drift["change_sigma"]
    assert f"Sensor {NAMES[MOVED]} is off" in found["in_words"][1]
    assert "rolled about its optical axis, by" in found["in_words"][1]
    assert found["against"] == given.get("against", "positions")


def test_a_frame_that_was_pushed_blames_no_sensor(client: Any):
    # Its names are those of the calibration's control points; it stands 2 mm further.
    points = bare(read(MODELS, PLACES[:8] + np.array([2.0, 0.0, 0.0]), 7))
    found = client.post(URL, json={"points": points, "against": "calibration"}).json()
    assert (found["status"], found["moved"]) == ("moved-as-a-whole", [])
    assert found["check"]["translation_mm"] == pytest.approx(2.0, abs=0.2)


def test_the_history_of_a_device_is_listed(client: Any):
    for number in range(3):
        points = read(moved_models() if number == 1 else MODELS, PLACES[:8], 10 + number)
        made = client.post(URL, json={"id": f"week-{number}", "points": points})
        assert made.status_code == 201, made.text
    url = "/api/v1/drift-checks"
    newest = client.get(url, params={"device_id": "sim", "limit": 3}).json()
    assert [one["id"] for one in newest["items"]] == ["week-2", "week-1", "week-0"]
    assert [one["status"] for one in newest["items"]] == ["good", "sensors-moved", "good"]
    assert "points" not in newest["items"][0]
    good = client.get(url, params={"calibration_id": "measured", "good": True}).json()
    assert {"week-0", "week-2", "before"} <= {one["id"] for one in good["items"]}
    assert "week-1" not in {one["id"] for one in good["items"]}
    assert client.get(url, params={"calibration_id": "sim-nominal"}).json()["items"] == []


@pytest.mark.slow
def test_an_update_run_makes_a_calibration_that_holds_again(client: Any):
    points = read(moved_models(), PLACES[:8], 20)
    client.post(URL, json={"id": "drifted", "points": points, "position_sigma_mm": 0.01})
    body = {
        "id": "mend", "device_id": "sim", "drift_check_id": "drifted", "sensors": [NAMES[MOVED]],
        "result_id": "mended", "note": "it was knocked",
    }  # fmt: skip
    posted = client.post("/api/v1/runs/update", json=body)
    assert posted.status_code == 202, posted.text
    assert posted.headers["location"] == "/api/v1/runs/mend"
    run = finished(client, "mend")
    assert (run["state"], run["result_path"]) == ("succeeded", "/api/v1/calibrations/mended"), run
    parent = client.get("/api/v1/calibrations/measured").json()
    made = client.get("/api/v1/calibrations/mended").json()
    assert (made["provenance"], made["method"], made["state"]) == ("updated", "update", "available")
    assert made["parent"] == {"id": "measured", "content_hash": parent["content_hash"]}
    assert made["note"] == "it was knocked"
    assert made["errors"]["fitted"]["statistics"]["points"] == 8
    # The recipe of the documentation gives its hash, with the parent in it.
    hashed = {name: made[name] for name in ("provenance", "points", "result", "parent")}
    hashed["device"] = made["device_id"]
    text = json.dumps(hashed, sort_keys=True, separators=(",", ":"), ensure_ascii=False)
    assert hashlib.sha256(text.encode()).hexdigest() == made["content_hash"]
    # Other markers than those that mended it.
    again = {"points": read(moved_models(), PLACES[8:16], 21)}
    repaired = client.post("/api/v1/calibrations/mended/drift-checks", json=again).json()
    assert repaired["status"] == "good", repaired["in_words"]
    assert client.post(URL, json=again).json()["status"] == "sensors-moved"
    assert client.get("/api/v1/devices/sim").json()["active_calibration_id"] == "sim-nominal"


def test_an_update_against_earlier_readings_has_no_control_points(client: Any):
    body = {
        "id": "by-capture", "device_id": "sim", "calibration_id": "measured", "capture_id": "now",
        "against": "capture", "earlier_capture_id": "then", "result_id": "by-capture",
        "sensors": [NAMES[MOVED]],
    }  # fmt: skip
    assert client.post("/api/v1/runs/update", json=body).status_code == 202
    assert finished(client, "by-capture")["state"] == "succeeded"
    made = client.get("/api/v1/calibrations/by-capture").json()
    assert (made["points"], made["errors"]["fitted"]) == ([], None)
    # The change alone is estimated: the other sensors stay what they were.
    parent = client.get("/api/v1/calibrations/measured").json()
    changed = [
        one["model"] != other["model"]
        for one, other in zip(parent["result"]["sensors"], made["result"]["sensors"], strict=True)
    ]
    assert changed == [place == MOVED for place in range(len(NAMES))]
    again = {"points": read(moved_models(), PLACES[8:16], 22)}
    found = client.post("/api/v1/calibrations/by-capture/drift-checks", json=again).json()
    assert found["status"] == "good", found["in_words"]


@pytest.mark.parametrize(
    ("given", "status", "words"),
    [
        ({}, 422, "of points and capture_id neither"),
        ({"points": read(MODELS, PLACES[:4], 1), "capture_id": "now"}, 422, "and capture_id both"),
        ({"points": bare(read(MODELS, PLACES[:4], 1))}, 422, '"P1" has no position_mm'),
        ({"capture_id": "now", "against": "capture"}, 422, "earlier_capture_id is missing"),
        (
            {"capture_id": "now", "earlier_capture_id": "then"},
            422,
            "earlier_capture_id is given against",
        ),
        ({"capture_id": "nothing"}, 404, '"nothing"'),
        ({"id": "before", "capture_id": "now"}, 409, '"before" exists already'),
        (
            {"points": [{"name": "Q", "readings": {}}], "against": "calibration"},
            422,
            'point "Q" is not among the control points of calibration "measured", which are P1',
        ),
        (
            {"points": [{"name": "Q", "position_mm": [0, 0, 0], "readings": {}}]},
            422,
            "no stationary marker can be compared",
        ),
    ],
)  # fmt: skip
def test_what_cannot_be_compared_is_refused(
    client: Any, given: dict[str, Any], status: int, words: str
):
    before = len(client.get("/api/v1/drift-checks").json()["items"])
    refused = client.post(URL, json=given)
    assert refused.status_code == status, refused.text
    assert words in refused.json()["detail"]
    assert len(client.get("/api/v1/drift-checks").json()["items"]) == before


@pytest.mark.parametrize(
    ("given", "status", "words"),
    [
        ({"sensors": ["sixth"]}, 422, "there is no sensor sixth"),
        ({"allowance": {"colour": 1.0}}, 422, "allowance has colour"),
        ({"capture_id": "now"}, 422, "capture_id is given with drift_check_id"),
        ({"calibration_id": "sim-nominal"}, 422, 'is of calibration "measured"'),
        ({"drift_check_id": "nothing"}, 404, 'no drift check "nothing"'),
    ],
)
def test_an_update_that_cannot_be_is_refused_when_it_is_posted(
    client: Any, given: dict[str, Any], status: int, words: str
):
    body = {"device_id": "sim", "drift_check_id": "before"} | given
    refused = client.post("/api/v1/runs/update", json=body)
    assert refused.status_code == status, refused.text
    assert words in refused.json()["detail"]


def test_more_readings_than_are_solved_within_a_request_are_refused():
    sensors = [Sensor(f"s{number}", 2048, 14.0) for number in range(6)]
    markers = [StationaryMarker(name=f"P{number}", readings={}) for number in range(200)]
    with pytest.raises(InvalidParameter, match="200 markers of 6 sensors are 1200 readings"):
        marker_arrays(markers, sensors, NEVER_USED, 0.0)


def test_a_device_takes_its_drift_checks_with_it(sqlite_client: Any):
    body = NEW_DRIFT_CHECKS["frame"]["value"]
    made = sqlite_client.post("/api/v1/calibrations/sim-nominal/drift-checks", json=body)
    assert made.status_code == 201, made.text
    assert sqlite_client.delete("/api/v1/devices/sim?cascade=true").status_code == 204
    assert sqlite_client.get("/api/v1/drift-checks").json()["items"] == []


def test_drift_is_told_to_webhooks_and_good_checks_are_not(
    client: Any, monkeypatch: pytest.MonkeyPatch
):
    told: list[tuple[str, dict[str, Any]]] = []
    monkeypatch.setattr(client.app.state.webhooks, "emit", lambda *event: told.append(event))
    client.post(URL, json={"points": read(MODELS, PLACES[:8], 5)})
    assert told == []
    made = client.post(URL, json={"points": read(moved_models(), PLACES[:8], 5)}).json()
    [(kind, data)] = told
    assert kind == "drift.detected"
    assert data["drift_check_id"] == made["id"]
    assert (data["status"], data["moved"]) == ("sensors-moved", [NAMES[MOVED]])
