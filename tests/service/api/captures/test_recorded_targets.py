"""Captures of targets from a recording: the readings that `lumiline readings` writes, over REST."""

import shutil
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from compute.camera.stack import CameraStack
from hardware.simulated.simulated_rig import simulated_sensor_models
from service.api.captures.examples import NEW_CAPTURES
from service.api.captures.schema import CaptureSettings, Target
from service.api.devices.schema import Sensor
from service.api.recordings.recorded_readings import captured_targets
from service.api.recordings.recording_process import MAX_CONCURRENT
from service.application.app import create_app
from service.jobs.call_process import CallProcess
from service.problems.errors import SensorsChanged
from service.settings import Settings
from tests.service.api.runs.in_process_worker import use_in_process_worker
from tests.service.api.runs.test_runs import QUICK, wait
from tests.service.cli.test_commands import here
from tests.service.fake_pipeline import FakePipeline, TestClient

URL = "/api/v1/captures"
TARGETS: list[dict[str, Any]] = NEW_CAPTURES["frame"]["value"]["targets"]
BODY = {"id": "recorded", "device_id": "sim", "targets": TARGETS, "recording_id": "frame.h5"}
SENSORS = [Sensor(model.name, model.pixels, 10.0) for model in simulated_sensor_models()]


@pytest.fixture(scope="module")
def frame(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The calibration frame of 19 strobed markers, 10 cycles."""
    folder: Path = tmp_path_factory.mktemp("recorded")
    settings = folder / "settings.json"
    settings.write_text('{"scene": {"kind": "calibration-frame"}}', encoding="utf-8")
    here("record", folder / "frame.h5", "--seconds", "0.19", "--simulation", settings)
    return folder / "frame.h5"


@pytest.fixture
def client(settings: Settings, frame: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """A server with the recording, which computes in its own process."""
    use_in_process_worker(monkeypatch)

    def call(_self: Any, function: Any, *arguments: Any, timeout_s: float) -> Any:
        return function(*arguments)

    monkeypatch.setattr(CallProcess, "call", call)
    settings.folders.recordings.mkdir(parents=True, exist_ok=True)
    shutil.copy(frame, settings.folders.recordings / "frame.h5")
    with TestClient(create_app(settings, FakePipeline())) as client:
        yield client


def test_create_capture_from_a_recording_is_complete_and_calibrates(client: Any) -> None:
    made = client.post(URL, json=BODY)
    assert made.status_code == 201, made.text
    session = made.json()
    assert (session["recording_id"], session["left"], session["next"]) == ("frame.h5", 0, None)
    assert client.get(f"{URL}/recorded").json() == session
    expected = CameraStack.of(simulated_sensor_models()).project(
        np.array([target["position_mm"] for target in TARGETS])
    )
    columns = {sensor.name: index for index, sensor in enumerate(SENSORS)}
    for row, captured in enumerate(session["captured"]):
        assert captured["frames"] == 10
        for one in captured["sensors"]:
            error = abs(one["mean_px"] - expected[row, columns[one["sensor"]]])
            assert error < 6.0 * np.hypot(one["sigma_px"], 0.01)
    run = {"device_id": "sim", "capture_id": "recorded", "id": "r", "result_id": "made"} | QUICK
    assert client.post("/api/v1/runs/calibration", json=run).status_code == 202
    assert wait(client, "r")["state"] == "succeeded"
    assert len(client.get("/api/v1/calibrations/made").json()["points"]) == len(TARGETS)


def test_create_capture_without_a_recording_names_none(client: Any) -> None:
    made = client.post(URL, json={**BODY, "recording_id": None}).json()
    assert (made["recording_id"], made["left"]) == (None, len(TARGETS))


@pytest.mark.parametrize(
    ("changes", "status", "kind", "detail"),
    [
        ({"recording_id": "none.h5"}, 404, "unknown-recording", '"none.h5"'),
        ({"targets": [{**TARGETS[0], "marker": 19}]}, 422, "invalid-parameter", "markers 0 to 18"),
        ({"targets": [{**TARGETS[0], "marker": None}]}, 422, "invalid-parameter", "its `marker`"),
        (
            {"targets": [TARGETS[0], {**TARGETS[1], "marker": TARGETS[0]["marker"]}]},
            409, "marker-not-moved", '"P2" reads as target "P1"',
        ),
    ],
)  # fmt: skip
def test_create_capture_from_a_recording_refused_nothing_stored(
    client: Any, changes: dict[str, Any], status: int, kind: str, detail: str
) -> None:
    refused = client.post(URL, json=BODY | changes)
    assert refused.status_code == status, refused.text
    assert refused.json()["type"] == f"/problems/{kind}"
    assert detail in refused.json()["detail"]
    assert client.get(f"{URL}/recorded").status_code == 404


def test_create_capture_from_a_damaged_recording_is_refused(
    client: Any, settings: Settings
) -> None:
    path = settings.folders.recordings / "frame.h5"
    path.write_bytes(path.read_bytes()[:4000])
    refused = client.post(URL, json=BODY)
    assert refused.json()["type"] == "/problems/invalid-recording"


def test_captured_targets_settings_name_the_marker_of_those_without(frame: Path) -> None:
    targets = [Target(name="P3", position_mm=(0.0, 0.0, 1500.0))]
    found = captured_targets(frame, "sim", SENSORS, targets, CaptureSettings(marker=2))
    named = [targets[0].model_copy(update={"marker": 2})]
    again = captured_targets(frame, "sim", SENSORS, named, CaptureSettings())
    assert found[0].sensors == again[0].sensors


def test_captured_targets_of_another_device_is_refused(frame: Path) -> None:
    targets = [Target(name="P1", position_mm=(0.0, 0.0, 1500.0), marker=0)]
    with pytest.raises(SensorsChanged, match="other"):
        captured_targets(frame, "other", SENSORS[:3], targets, CaptureSettings())


def test_create_capture_does_not_wait_for_players(client: Any) -> None:
    """Not even where as many of these wait as may."""
    with ExitStack() as stack:
        for _ in range(MAX_CONCURRENT):
            stack.enter_context(client.app.state.recalculation._process._limit)
        assert client.post(URL, json=BODY).status_code == 201
