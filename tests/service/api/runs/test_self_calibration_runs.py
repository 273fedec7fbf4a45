"""Self-calibration runs: from a wand to a stored calibration that reconstructs new points."""

import copy
from typing import Any

import numpy as np
import pytest
from pydantic import TypeAdapter

from compute.calibration.result import Calibration
from compute.calibration.self_calibration.uncalibrated_start import pixel_directions
from compute.camera.stack import CameraStack
from compute.reconstruction.triangulation import reconstruct
from hardware.simulated.simulated_rig import WORKING_CENTRE_MM, simulated_sensor_models
from service.api.reports import router
from service.api.reports.page import report_page
from service.api.runs.examples import NEW_SELF_CALIBRATION_RUNS
from tests.service.api.runs.in_process_worker import use_in_process_worker
from tests.service.api.runs.test_runs import wait

URL = "/api/v1/runs/self-calibration"
BODY = NEW_SELF_CALIBRATION_RUNS["wand"]["value"]


@pytest.mark.slow
def test_a_wand_calibrates_the_device(client: Any, monkeypatch: pytest.MonkeyPatch):
    use_in_process_worker(monkeypatch)
    monkeypatch.setattr(router, "render_page", report_page)
    body = BODY | {"result_id": "by-wand", "start_calibration_id": "sim-nominal", "note": "waved"}
    posted = client.post(URL, json=body)
    assert posted.status_code == 202, posted.text
    found = wait(client, "sim-wand-run")
    assert (found["state"], found["kind"], found["problem"]) == (
        "succeeded", "self-calibration", None,
    )  # fmt: skip
    made = client.get("/api/v1/calibrations/by-wand").json()
    assert (made["provenance"], made["method"], made["note"]) == (
        "self-calibrated", "self-calibration", "waved",
    )  # fmt: skip
    result = TypeAdapter(Calibration).validate_python(made["result"])
    places = np.asarray(WORKING_CENTRE_MM) + np.random.default_rng(3).uniform(-120, 120, (50, 3))
    readings = CameraStack.of(simulated_sensor_models()).project(places)
    points = reconstruct(result.models, readings, np.full(4, 0.01)).position_mm
    # Readings to 0.01 px: distances between points are right to hundredths of a millimetre.
    apart = [np.linalg.norm(one[:25] - one[25:], axis=1) for one in (points, places)]
    assert np.abs(apart[0] - apart[1]).max() < 0.2
    assert client.post("/api/v1/calibrations/by-wand/activate").status_code == 200
    assert client.get("/api/v1/calibrations/by-wand/report.html").status_code == 200


def test_what_is_no_wand_is_refused_at_once(sqlite_client: Any):
    def refused(change: Any) -> tuple[str, str]:
        body = copy.deepcopy(BODY)
        change(body["recordings"][0])
        answer = sqlite_client.post(URL, json=body).json()
        return answer["type"], answer["detail"]

    def one_marker(recording: Any) -> None:
        recording["target"]["position_mm"] = [0.0]
        for pose in recording["poses"]:
            for name in pose:
                pose[name] = pose[name][:1]

    kind, detail = refused(one_marker)
    assert kind in ("/problems/invalid-parameter", "/problems/too-few-points")
    assert "marker" in detail
    kind, detail = refused(lambda recording: recording["poses"][0].update(vertical=[1.0]))
    assert (kind, "2 markers" in detail) == ("/problems/invalid-parameter", True)
    kind, detail = refused(lambda recording: recording["poses"][3].update(sixth=[1.0, 2.0]))
    assert (kind, "pose 4" in detail) == ("/problems/unknown-sensor", True)
    kind, detail = refused(lambda recording: recording["poses"][3].update(vertical=[1.0, 5000.0]))
    assert (kind, "5000 px" in detail) == ("/problems/reading-outside-sensor", True)
    assert sqlite_client.get("/api/v1/runs").json()["items"] == []


@pytest.mark.slow
def test_a_wand_calibrates_a_device_without_a_start(client: Any, monkeypatch: pytest.MonkeyPatch):
    use_in_process_worker(monkeypatch)
    models = simulated_sensor_models()
    degrees = np.rad2deg(np.arctan2(*pixel_directions(models).T[::-1])).round(-1)
    names = [model.name for model in models]
    body = BODY | {
        "result_id": "from-nothing",
        "initial": "readings",
        "directions_deg": dict(zip(names, degrees.tolist(), strict=True)),
    }
    assert client.post(URL, json=body).status_code == 202
    found = wait(client, "sim-wand-run")
    assert (found["state"], found["problem"]) == ("succeeded", None)
    made = client.get("/api/v1/calibrations/from-nothing").json()
    assert made["note"] == ""
    result = TypeAdapter(Calibration).validate_python(made["result"])
    places = np.asarray(WORKING_CENTRE_MM) + np.random.default_rng(3).uniform(-120, 120, (50, 3))
    readings = CameraStack.of(models).project(places)
    points = reconstruct(result.models, readings, np.full(4, 0.01)).position_mm
    apart = [np.linalg.norm(one[:25] - one[25:], axis=1) for one in (points, places)]
    assert np.abs(apart[0] - apart[1]).max() < 0.2


def test_a_scale_that_differs_stands_in_the_note_and_the_report(
    client: Any, monkeypatch: pytest.MonkeyPatch
):
    use_in_process_worker(monkeypatch)
    monkeypatch.setattr(router, "render_page", report_page)
    body = copy.deepcopy(BODY) | {"result_id": "longer", "note": "waved"}
    body["recordings"][0]["target"]["position_mm"] = [0.0, 315.0]
    assert client.post(URL, json=body).status_code == 202
    assert wait(client, "sim-wand-run")["state"] == "succeeded"
    note = client.get("/api/v1/calibrations/longer").json()["note"]
    assert note.startswith("waved\nWARNING: The known lengths make the device 1.05 times as large")
    assert "1.05 times as large" in client.get("/api/v1/calibrations/longer/report.html").text


def test_a_run_without_a_start_is_refused_at_once_where_it_cannot_be(sqlite_client: Any):
    def refused(**changes: Any) -> tuple[str, str]:
        answer = sqlite_client.post(URL, json=copy.deepcopy(BODY) | changes).json()
        return answer["type"].removeprefix("/problems/"), answer["detail"]

    kind, detail = refused(initial="readings", directions_deg={"vertical": 0.0})
    assert (kind, "give one for each of" in detail) == ("invalid-parameter", True)
    kind, detail = refused(initial="readings", directions_deg={"sixth": 0.0})
    assert (kind, '"sixth"' in detail) == ("unknown-sensor", True)
    kind, detail = refused(distortion="symmetric-3")
    assert (kind, "without a start" in detail) == ("invalid-parameter", True)
    body = copy.deepcopy(BODY)["recordings"][0]
    body["target"] = {
        "kind": "rigid-body", "marker_mm": [[0, 0, 0], [9, 0, 0], [0, 9, 0]],
    }  # fmt: skip
    body["poses"] = [{"vertical": [1.0, 2.0, 3.0]}]
    kind, detail = refused(initial="readings", recordings=[body])
    assert (kind, "no wand" in detail) == ("too-few-points", True)
