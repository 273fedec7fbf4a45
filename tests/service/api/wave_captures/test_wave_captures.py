"""/api/v1/wave-captures: begun, started, waved, stopped, calibrated with; both databases."""

import time
from typing import Any

import numpy as np
import pytest
from pydantic import TypeAdapter

from compute.calibration.result import Calibration
from compute.calibration.self_calibration.uncalibrated_start import pixel_directions
from compute.camera.stack import CameraStack
from compute.reconstruction.triangulation import reconstruct
from hardware.simulated.driver import SimulatedDriver
from hardware.simulated.scenes import WavedWand
from hardware.simulated.settings import SimulationSettings
from service.api.wave_captures.examples import NEW_WAVE_CAPTURES
from service.application.app import create_app
from service.database.models import WaveCaptureRow
from service.pipeline.frame_batch import FrameBatch
from service.settings import Settings
from tests.service.api.runs.in_process_worker import use_in_process_worker
from tests.service.api.runs.test_runs import wait
from tests.service.api.wave_captures.waves import (
    LENGTH_MM,
    MODELS,
    NAMES,
    ends_mm,
    saturate,
    waved,
)
from tests.service.fake_pipeline import FakePipeline, TestClient

URL = "/api/v1/wave-captures"
SESSION = f"{URL}/sim-wave-capture"
RUNS = "/api/v1/runs/self-calibration"
BODY = NEW_WAVE_CAPTURES["wand"]["value"]
SERVER_STOPPED = "the server stopped; the poses so far are kept"
LONG = BODY | {"settings": {"duration_s": 600.0, "end_when_enough": False}}


def showing(live: FakePipeline, wave: list[FrameBatch], **settings: Any) -> None:
    """Let the device show the batches of a wave from the next start on."""
    scene = SimulationSettings(scene=WavedWand(), **settings)
    live.records = SimulatedDriver("sim", scene).description
    live.batches = wave


def ended(client: Any) -> dict[str, Any]:
    """The session once no poses are taken any more."""
    end = time.monotonic() + 240.0
    while (found := client.get(SESSION).json())["state"] == "capturing":
        assert time.monotonic() < end, found
        time.sleep(0.05)
    return dict(found)


def refused(answer: Any) -> tuple[str, str]:
    return answer.json()["type"].removeprefix("/problems/"), answer.json()["detail"]


def directions() -> dict[str, float]:
    """Of the sensors' pixels, to ten degrees."""
    degrees = np.rad2deg(np.arctan2(*pixel_directions(MODELS).T[::-1])).round(-1)
    return dict(zip(NAMES, degrees.tolist(), strict=True))


def check_lengths(calibration: dict[str, Any]) -> None:
    """The cameras measure other lengths right, to a few tenths of a millimetre."""
    result = TypeAdapter(Calibration).validate_python(calibration["result"])
    places = ends_mm(np.random.default_rng(9).uniform(0.0, 1e4, 40)).reshape(-1, 3)
    readings = CameraStack.of(MODELS).project(places)
    points = reconstruct(result.models, readings, np.full(4, 0.01)).position_mm
    apart = np.linalg.norm(np.diff(points.reshape(-1, 2, 3), axis=1)[:, 0], axis=1)
    assert np.abs(apart - LENGTH_MM).max() < 0.5


@pytest.mark.slow
def test_a_wave_is_taken_until_it_is_enough_and_calibrates(
    client: Any, live: FakePipeline, monkeypatch: pytest.MonkeyPatch
):
    use_in_process_worker(monkeypatch)
    showing(live, waved(40.0))
    made = client.post(URL, json=BODY)
    assert made.status_code == 201, made.text
    assert made.headers["location"] == SESSION
    begun = made.json()
    assert (begun["state"], begun["left"], begun["ended"]) == ("ready", 100, None)
    assert "Start it" in begun["instruction"]
    started = client.post(f"{SESSION}/start")
    assert (started.status_code, started.json()["state"]) == (200, "capturing")
    found = ended(client)
    assert (found["state"], found["ended"], found["left"]) == ("stopped", "enough", 0)
    progress = found["progress"]
    assert progress["enough"]
    assert progress["missing"] == []
    exposures = progress["exposures"]
    assert exposures["taken"] > 100
    assert exposures["still"] > 10 * exposures["taken"]
    assert exposures["all"] == sum(exposures.values()) - exposures["all"] == 5000
    for sensor in progress["sensors"]:
        assert sensor["clear"] + sensor["unclear"] + sensor["unseen"] == 10_000
        assert sensor["unclear"] == 0
        assert sum(sensor["cells"]) == sensor["readings"]
    first, second = np.moveaxis(ends_mm(np.linspace(0.0, 40.0, 1000)), 1, 0)
    x, y, z = np.sqrt((((second - first) / LENGTH_MM) ** 2).mean(axis=0))
    # The pixels of the first sensor are vertical.
    assert progress["directions"]["rms"] == pytest.approx([y, x, z], abs=0.12)
    assert sum(progress["directions"]["bins"]) <= exposures["taken"]
    body = {"id": "by-wave", "device_id": "sim", "wave_capture_id": found["id"]}
    posted = client.post(RUNS, json=body | {"result_id": "waved"})
    assert posted.status_code == 202, posted.text
    assert wait(client, "by-wave")["state"] == "succeeded"
    calibration = client.get("/api/v1/calibrations/waved").json()
    assert calibration["provenance"] == "self-calibrated"
    check_lengths(calibration)
    lengths = calibration["errors"]["lengths_left_out"]
    assert 100 < lengths["poses"] <= exposures["taken"]
    assert abs(lengths["mean_mm"]) < lengths["rms_mm"] < lengths["max_mm"] < 2.0


@pytest.mark.slow
def test_a_wave_calibrates_a_device_without_any_calibration(
    client: Any, live: FakePipeline, monkeypatch: pytest.MonkeyPatch
):
    """What is covered is judged by cameras from the readings, and so is the start of the run."""
    use_in_process_worker(monkeypatch)
    showing(live, waved(40.0))
    source = {"kind": "simulated"}
    client.post("/api/v1/devices", json={"id": "bench", "title": "Bench", "source": source})
    body = BODY | {"device_id": "bench", "settings": {"duration_s": 600.0}}
    assert client.post(URL, json=body).status_code == 201
    assert client.post(f"{SESSION}/start").status_code == 200
    found = ended(client)
    assert (found["ended"], found["progress"]["missing"]) == ("enough", [])
    run = {"id": "by-wave", "device_id": "bench", "wave_capture_id": found["id"]}
    assert refused(client.post(RUNS, json=run))[0] == "no-active-calibration"
    run |= {"initial": "readings", "directions_deg": directions(), "result_id": "from-nothing"}
    assert client.post(RUNS, json=run).status_code == 202
    assert wait(client, "by-wave")["state"] == "succeeded"
    calibration = client.get("/api/v1/calibrations/from-nothing").json()
    assert calibration["note"] == ""
    check_lengths(calibration)


def test_what_is_missing_is_said_and_more_can_be_waved(sqlite_client: Any, live: FakePipeline):
    """First across the view only; then, after another start, towards the sensors too."""
    showing(live, waved(30.0, tilt=0.05))
    assert sqlite_client.post(URL, json=LONG).status_code == 201
    sqlite_client.post(f"{SESSION}/start")
    stopped = sqlite_client.post(f"{SESSION}/stop").json()
    assert (stopped["state"], stopped["ended"]) == ("stopped", "stopped")
    [missing] = stopped["progress"]["missing"]
    assert "towards the sensors" in missing
    assert stopped["instruction"] == f"Start it again and wave on. {missing}"
    taken = stopped["progress"]["exposures"]["taken"]
    assert sqlite_client.post(f"{SESSION}/stop").json() == stopped
    showing(live, waved(40.0, start_s=30.0))
    sqlite_client.post(f"{SESSION}/start")
    more = sqlite_client.post(f"{SESSION}/stop").json()
    assert more["progress"]["exposures"]["taken"] > taken + 80
    assert more["progress"]["enough"]
    assert "post a self-calibration run" in more["instruction"]


def test_readings_that_are_not_usable_are_counted(sqlite_client: Any, live: FakePipeline):
    showing(live, waved(8.0, change=saturate))
    sqlite_client.post(URL, json=LONG)
    sqlite_client.post(f"{SESSION}/start")
    found = sqlite_client.post(f"{SESSION}/stop").json()
    first, *others = found["progress"]["sensors"]
    assert (first["clear"], first["readings"]) == (0, 0)
    assert first["unclear"] > 1500
    assert all(one["unclear"] == 0 for one in others)
    assert f"Sensor {NAMES[0]} saw nothing." in found["progress"]["missing"]


def test_a_session_survives_a_restart_and_keeps_its_poses(sqlite_settings: Settings):
    first = FakePipeline()
    showing(first, waved(10.0))
    with TestClient(create_app(sqlite_settings, first)) as client:
        client.post(URL, json=LONG)
        client.post(f"{SESSION}/start")
        listed = client.get(URL, params={"device_id": "sim"}).json()["items"]
        assert [one["state"] for one in listed] == ["capturing"]
    second = FakePipeline()
    with TestClient(create_app(sqlite_settings, second)) as client:
        found = client.get(SESSION).json()
        assert (found["state"], found["ended"]) == ("stopped", SERVER_STOPPED)
        assert found["progress"]["exposures"]["taken"] > 40
        kept = found["progress"]["exposures"]["taken"]
        showing(second, waved(10.0, start_s=10.0))
        client.post(f"{SESSION}/start")
        progress = client.post(f"{SESSION}/stop").json()["progress"]
        assert progress["poses"] == progress["exposures"]["taken"] > kept + 40


@pytest.mark.slow
def test_wave_whose_measurement_the_servers_end_stops_keeps_its_poses_and_says_so(
    sqlite_client: Any, live: FakePipeline
):
    showing(live, waved(10.0))
    sqlite_client.post(URL, json=LONG)
    sqlite_client.post(f"{SESSION}/start")
    end = time.monotonic() + 240.0
    while sqlite_client.get(SESSION).json()["progress"]["poses"] <= 40:
        assert time.monotonic() < end
        time.sleep(0.05)
    live.streams.close("the server is stopping")
    found = ended(sqlite_client)
    assert (found["state"], found["ended"]) == ("stopped", SERVER_STOPPED)
    assert found["progress"]["exposures"]["taken"] > 40


def test_wave_that_is_started_while_another_one_ends_keeps_the_poses_of_both(
    sqlite_client: Any, live: FakePipeline, monkeypatch: pytest.MonkeyPatch
):
    showing(live, waved(10.0))
    sqlite_client.post(URL, json=LONG)
    sqlite_client.post(f"{SESSION}/start")
    find, first = live.session, []

    def end_first(device_id: str) -> Any:
        sqlite_client.app.state.wave_captures.stop("sim-wave-capture")
        with sqlite_client.app.state.database.read() as session:
            first.append(session.get_one(WaveCaptureRow, "sim-wave-capture").progress["poses"])
        return find(device_id)

    monkeypatch.setattr(live, "session", end_first)
    showing(live, waved(10.0, start_s=10.0))
    assert sqlite_client.post(f"{SESSION}/start").status_code == 200
    both = sqlite_client.post(f"{SESSION}/stop").json()["progress"]
    assert both["poses"] == both["exposures"]["taken"] > first[0] + 40 > 80


def test_what_cannot_be_waved_is_refused(sqlite_client: Any, live: FakePipeline):
    live.records = None
    for change, words in (
        ({"target": {"kind": "wand", "position_mm": [0.0]}}, "1 marker"),
        ({"markers": [0]}, "the target has 2 markers"),
        ({"markers": [1, 1]}, "has one twice"),
    ):
        kind, detail = refused(sqlite_client.post(URL, json=BODY | change))
        assert (kind, words in detail) == ("invalid-parameter", True), detail
    assert sqlite_client.post(URL, json=BODY).status_code == 201
    assert refused(sqlite_client.post(URL, json=BODY))[0] == "wave-capture-exists"
    assert refused(sqlite_client.post(f"{SESSION}/start"))[0] == "device-not-running"
    assert refused(sqlite_client.post(f"{URL}/none/start"))[0] == "unknown-wave-capture"
    showing(live, [], illumination="simultaneous")
    kind, detail = refused(sqlite_client.post(f"{SESSION}/start"))
    assert (kind, "they are lit together" in detail) == ("invalid-parameter", True)
    run = {"device_id": "sim", "wave_capture_id": "sim-wave-capture"}
    assert refused(sqlite_client.post(RUNS, json=run))[0] == "capture-incomplete"
    assert refused(sqlite_client.post(RUNS, json={"device_id": "sim"}))[0] == "invalid-parameter"
    unknown = run | {"wave_capture_id": "none"}
    assert refused(sqlite_client.post(RUNS, json=unknown))[0] == "unknown-wave-capture"


def test_one_session_of_a_device_takes_poses_at_a_time(sqlite_client: Any, live: FakePipeline):
    showing(live, waved(2.0))
    sqlite_client.post(URL, json=LONG)
    sqlite_client.post(URL, json=LONG | {"id": "other"})
    sqlite_client.post(f"{SESSION}/start")
    kind, detail = refused(sqlite_client.post(f"{URL}/other/start"))
    assert (kind, '"sim-wave-capture" takes poses' in detail) == ("busy", True)
    assert sqlite_client.delete(SESSION).status_code == 204
    assert sqlite_client.get(SESSION).status_code == 404
    assert sqlite_client.post(f"{URL}/other/start").status_code == 200
    assert sqlite_client.post(f"{URL}/other/stop").json()["progress"]["exposures"]["taken"] > 0


def test_it_ends_with_its_time(sqlite_client: Any, live: FakePipeline):
    showing(live, waved(2.0))
    sqlite_client.post(URL, json=BODY | {"settings": {"duration_s": 0.2}})
    sqlite_client.post(f"{SESSION}/start")
    assert ended(sqlite_client)["ended"] == "0.2 s were over"
