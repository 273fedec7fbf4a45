"""/api/v1/captures: target by target, over a restart, into a calibration run; both databases."""

from typing import Any

import numpy as np
import pytest

from compute.camera.stack import CameraStack
from hardware.simulated.bar import simulated_sensor_models
from service.app import create_app
from service.captures.examples import NEW_CAPTURES
from service.settings import Settings
from tests.service.recorded_live import RecordedLive, TestClient
from tests.service.runs.test_runs import wait

URL = "/api/v1/captures"
BODY = NEW_CAPTURES["frame"]["value"]


def place(live: RecordedLive, target: Any) -> None:
    """Hold a marker at a target, as the simulated sensors see it."""
    stack = CameraStack.of(simulated_sensor_models())
    live.seen_px = stack.project(np.array([target["position_mm"]]))[0]


def test_a_session_is_captured_target_by_target_and_calibrates(settings: Settings):
    first = RecordedLive()
    with TestClient(create_app(settings, first)) as client:
        made = client.post(URL, json=BODY)
        assert made.status_code == 201, made.text
        assert made.headers["location"] == f"{URL}/sim-capture"
        assert (made.json()["next"], made.json()["left"]) == ("P1", 19)
        for target in BODY["targets"][:9]:
            place(first, target)
            found = client.post(f"{URL}/sim-capture/capture").json()
        assert (found["next"], found["left"]) == ("P10", 10)
        early = {"device": "sim", "capture": "sim-capture"}
        refused = client.post("/api/v1/calibration-runs", json=early)
        assert refused.json()["type"] == "/problems/capture-incomplete"
        assert "10 of 19" in refused.json()["detail"]
    second = RecordedLive()
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
        body = early | {"id": "captured", "result_id": "by-capture", "distortion": "none"}
        assert client.post("/api/v1/calibration-runs", json=body).status_code == 202
        assert wait(client, "captured")["state"] == "succeeded"
        made_from = client.get("/api/v1/calibrations/by-capture").json()
        assert [point["name"] for point in made_from["points"]] == [
            target["name"] for target in BODY["targets"]
        ]
        reading = made_from["points"][0]["readings"]["vertical"]
        # Twenty frames of 0.05 px.
        assert reading["sigma_px"] == pytest.approx(0.05 / np.sqrt(20), rel=0.6)
        assert next(call[:4] for call in second.calls if call[0] == "collect") == (
            "collect", "sim", 20, 0,
        )  # fmt: skip


def test_what_cannot_be_captured_is_told_and_nothing_is_stored(
    sqlite_client: Any, live: RecordedLive, monkeypatch: pytest.MonkeyPatch
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
    assert sqlite_client.post(URL, json=BODY).json()["type"] == "/problems/capture-exists"
    assert sqlite_client.get(URL).json()["total"] == 1
