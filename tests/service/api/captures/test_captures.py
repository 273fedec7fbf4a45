"""/api/v1/captures: target by target, over a restart, into a calibration run; both databases."""

from typing import Any

import numpy as np
import pytest

from compute.camera.stack import CameraStack
from hardware.simulated.simulated_rig import simulated_sensor_models
from service.api.captures.examples import NEW_CAPTURES
from service.application.app import create_app
from service.settings import Settings
from tests.service.api.runs.in_process_worker import use_in_process_worker
from tests.service.api.runs.test_runs import QUICK, wait
from tests.service.fake_pipeline import FakePipeline, TestClient

URL = "/api/v1/captures"
BODY = NEW_CAPTURES["frame"]["value"]


def place(live: FakePipeline, target: Any) -> None:
    """Hold a marker at a target, as the simulated sensors see it."""
    stack = CameraStack.of(simulated_sensor_models())
    live.seen_px = stack.project(np.array([target["position_mm"]]))[0]


@pytest.mark.slow
def test_a_session_is_captured_target_by_target_and_calibrates(
    settings: Settings, monkeypatch: pytest.MonkeyPatch
):
    use_in_process_worker(monkeypatch)
    first = FakePipeline()
    with TestClient(create_app(settings, first)) as client:
        made = client.post(URL, json=BODY)
        assert made.status_code == 201, made.text
        assert made.headers["location"] == f"{URL}/sim-capture"
        assert (made.json()["next"], made.json()["left"]) == ("P1", 19)
        for target in BODY["targets"][:9]:
            place(first, target)
            found = client.post(f"{URL}/sim-capture/capture").json()
        assert (found["next"], found["left"]) == ("P10", 10)
        early = {"device_id": "sim", "capture_id": "sim-capture"}
        refused = client.post("/api/v1/runs/calibration", json=early)
        assert refused.json()["type"] == "/problems/capture-incomplete"
        assert "10 of 19" in refused.json()["detail"]
    second = FakePipeline()
    with TestClient(create_app(settings, second)) as client:
        assert client.get(f"{URL}/sim-capture").json() == found
        # Over again, by name: it replaces what was captured.
        place(second, {"position_mm": [0.0, 0.0, 1500.0]})
        again = client.post(f"{URL}/sim-capture/capture", params={"target": "P3"}).json()
        assert again["captured"][2] != found["captured"][2]
        place(second, BODY["targets"][2])
        client.post(f"{URL}/sim-capture/capture", params={"target": "P3"})
        for target in BODY["targets"][9:]:
            place(second, target)
            found = client.post(f"{URL}/sim-capture/capture").json()
        assert (found["next"], found["left"]) == (None, 0)
        refused = client.post(f"{URL}/sim-capture/capture")
        assert refused.json()["type"] == "/problems/capture-complete"
        body = early | {"id": "captured", "result_id": "by-capture"} | QUICK
        assert client.post("/api/v1/runs/calibration", json=body).status_code == 202
        assert wait(client, "captured")["state"] == "succeeded"
        made_from = client.get("/api/v1/calibrations/by-capture").json()
        assert [point["name"] for point in made_from["points"]] == [
            target["name"] for target in BODY["targets"]
        ]
        reading = made_from["points"][0]["readings"]["vertical"]
        # Twenty frames of 0.05 px.
        assert reading["sigma_px"] == pytest.approx(0.05 / np.sqrt(20), rel=0.6)
        markers = [call[1:4] for call in second.calls if call[0] == "collect"]
        assert markers == [("sim", 20, number) for number in (2, 2, *range(9, 19))]


def test_a_marker_that_was_not_moved_is_told(sqlite_client: Any, live: FakePipeline):
    """Also against an earlier target than the last, and when a target is captured again."""
    targets = [
        {"name": name, "position_mm": [10.0 * number, 0.0, 1500.0]}
        for number, name in enumerate("ABC")
    ]
    targets.append({"name": "beside A", "position_mm": [0.05, 0.0, 1500.0]})
    body = {"id": "steps", "device_id": "sim", "targets": targets, "settings": {"frames": 20}}
    assert sqlite_client.post(URL, json=body).status_code == 201

    def capture(at: int, **query: str) -> Any:
        place(live, targets[at])
        return sqlite_client.post(f"{URL}/steps/capture", params=query).json()

    assert capture(0)["left"] == 3
    refused = capture(0)
    assert refused["type"] == "/problems/marker-not-moved"
    assert 'target "B" reads as target "A" does' in refused["detail"]
    assert capture(1)["left"] == 2
    assert 'still at "A"?' in capture(0)["detail"]
    assert capture(2)["left"] == 1
    assert 'still at "B"?' in capture(1, target="A")["detail"]
    assert capture(0, target="A")["left"] == 1
    last = sqlite_client.get(f"{URL}/steps").json()
    assert last["instruction"] == (
        "Hold the marker still at beside A, (0.05, 0, 1500) mm, and capture it."
    )
    # A target beside it may read the same.
    done = capture(0)
    assert (done["left"], done["next"]) == (0, None)
    assert done["instruction"].startswith("All targets are captured")


@pytest.mark.slow
def test_captures_of_all_kinds_have_one_base(client: Any):
    """What they share has one name and one meaning, also in kinds that come later."""
    schemas = client.app.openapi()["components"]["schemas"]
    kinds = {
        name: schema["properties"]
        for name, schema in schemas.items()
        if {"captured", "settings"} <= schema.get("properties", {}).keys()
    }
    assert set(kinds) == {"Capture", "RadiometricCapture"}
    shared = set.intersection(*(set(members) for members in kinds.values()))
    assert shared >= {
        *("id", "device_id", "settings", "captured", "next", "instruction", "left", "note"),
        *("created_at", "updated_at"),
    }
    assert {"frames", "captured_at", "sensors"} <= (
        schemas["CapturedTarget"]["properties"].keys()
        & schemas["CapturedFrames"]["properties"].keys()
    )


def test_a_session_is_deleted(client: Any):
    client.post(URL, json=BODY)
    assert client.delete(f"{URL}/sim-capture").status_code == 204
    assert client.get(URL).json()["items"] == []
    assert client.delete(f"{URL}/sim-capture").json()["type"] == "/problems/unknown-capture"


@pytest.mark.parametrize("name", ["P1", "elsewhere"])
def test_a_session_made_anew_meanwhile_is_not_given_the_formers_readings(
    client: Any, live: FakePipeline, monkeypatch: pytest.MonkeyPatch, name: str
):
    """Whether it has a target of the same name or not."""
    assert client.post(URL, json=BODY).status_code == 201
    place(live, BODY["targets"][0])

    def replaced(*asked: Any) -> Any:
        assert client.delete(f"{URL}/sim-capture").status_code == 204
        targets = [{"name": name, "position_mm": [50.0, 0.0, 1500.0]}]
        assert client.post(URL, json=BODY | {"targets": targets}).status_code == 201
        return read(*asked)

    read = live.collect
    monkeypatch.setattr(live, "collect", replaced)
    answer = client.post(f"{URL}/sim-capture/capture")
    assert answer.status_code == 404, answer.text
    assert answer.json()["type"] == "/problems/unknown-capture"
    assert "created again" in answer.json()["detail"]
    assert client.get(f"{URL}/sim-capture").json()["captured"] == []


def test_a_target_names_its_marker_or_takes_the_settings(sqlite_client: Any, live: FakePipeline):
    targets = [
        {"name": f"P{number}", "position_mm": [30.0 * number, 0.0, 1500.0]} for number in range(3)
    ]
    targets[1]["marker"] = 7
    body = {"id": "own", "device_id": "sim", "targets": targets, "settings": {"marker": 2}}
    made = sqlite_client.post(URL, json=body).json()
    assert [target["marker"] for target in made["targets"]] == [None, 7, None]
    for target in targets:
        place(live, target)
        assert sqlite_client.post(f"{URL}/own/capture").status_code == 200
    assert [call[3] for call in live.calls if call[0] == "collect"] == [2, 7, 2]


def test_what_cannot_be_captured_is_told_and_nothing_is_stored(
    sqlite_client: Any, live: FakePipeline, monkeypatch: pytest.MonkeyPatch
):
    sqlite_client.post(URL, json=BODY)

    def refused(**query: Any) -> str:
        answer = sqlite_client.post(f"{URL}/sim-capture/capture", params=query)
        assert sqlite_client.get(f"{URL}/sim-capture").json()["left"] == 19
        kind: str = answer.json()["type"]
        return kind

    assert refused(target="P99") == "/problems/unknown-target"
    moving = np.full(4, 1000.0) + np.linspace(0.0, 5.0, 20)[:, None]
    monkeypatch.setattr(live, "collect", lambda *_: (moving, np.full((20, 4), 0.05)))
    assert refused() == "/problems/target-moved"
    monkeypatch.setattr(live, "collect", lambda *_: (moving[:3], np.full((3, 4), 0.05)))
    assert refused() == "/problems/nothing-seen"
    nothing = np.full((20, 4), np.nan)
    monkeypatch.setattr(live, "collect", lambda *_: (nothing, nothing))
    assert refused() == "/problems/nothing-seen"
    monkeypatch.undo()
    sqlite_client.post("/api/v1/devices/sim/stop")
    assert refused() == "/problems/device-not-running"
    twice = BODY | {"id": "twice", "targets": [BODY["targets"][0]] * 2}
    assert sqlite_client.post(URL, json=twice).json()["type"] == "/problems/duplicate-point"
    same = {"id": "same", "targets": [BODY["targets"][0], BODY["targets"][0] | {"name": "Q"}]}
    answer = sqlite_client.post(URL, json=BODY | same).json()
    assert answer["type"] == "/problems/duplicate-point"
    assert 'targets "P1" and "Q" have the same position' in answer["detail"]
    assert sqlite_client.post(URL, json=BODY).json()["type"] == "/problems/capture-exists"
    assert len(sqlite_client.get(URL).json()["items"]) == 1
