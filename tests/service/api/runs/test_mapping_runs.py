"""Mapping runs: a table for the calibration that was active, stored, downloadable, used."""

from typing import Any

import numpy as np
import pytest

from compute.camera.stack import CameraStack
from hardware.simulated.simulated_rig import simulated_sensor_models
from service.api.calibrations.examples import NEW_CALIBRATIONS
from service.api.correction_tables.hdf5_file import read_table
from service.api.runs.examples import NEW_MAPPING_RUNS
from tests.service.api.runs.in_process_worker import use_in_process_worker
from tests.service.api.runs.test_runs import wait

URL = "/api/v1/runs/mapping"
BODY = NEW_MAPPING_RUNS["grid"]["value"]


def bent(position_mm: Any) -> float:
    """What the first sensor reads too much at a place [px]."""
    x, y, _ = position_mm
    return 1e-4 * float(x) * float(y)


@pytest.mark.slow
def test_a_run_makes_the_table_that_mends_a_known_error(
    client: Any, live: Any, monkeypatch: pytest.MonkeyPatch
):
    use_in_process_worker(monkeypatch)
    points = [
        point | {"readings": point["readings"] | {
            "vertical": point["readings"]["vertical"] + bent(point["position_mm"])
        }}
        for point in BODY["points"]
    ]  # fmt: skip
    posted = client.post(
        URL, json=BODY | {"points": points, "note": "bent", "result_id": "sim-map"}
    )
    assert posted.status_code == 202, posted.text
    found = wait(client, "sim-map-run")
    assert (found["state"], found["problem"]) == ("succeeded", None)
    assert found["result_path"] == "/api/v1/correction-tables/sim-map"
    table = client.get(found["result_path"]).json()
    assert (table["calibration_id"], table["origin"], table["note"]) == (
        "sim-nominal", "run", "bent",
    )  # fmt: skip
    assert table["settings"]["points"] == 125
    assert table["settings"]["points_made_the_calibration"] is False
    made = read_table(client.get(f"{found['result_path']}/file").content)
    places = np.array([0.0, 0.0, 1500.0]) + np.random.default_rng(1).uniform(-80, 80, (200, 3))
    corrections = made.table.at(places)
    assert corrections.inside.mean() > 0.9
    wanted = np.zeros((200, 4))
    wanted[:, 0] = [-bent(place) for place in places]
    assert np.abs(wanted[:, 0]).max() > 0.3
    # Readings are rounded to 0.01 px.
    assert np.abs(corrections.value_px - wanted).max() < 0.03
    assert client.post("/api/v1/correction-tables/sim-map/activate").status_code == 200
    assert live.in_force["sim"].table_id == "sim-map"
    reconstructed = client.post("/api/v1/reconstructions", json=with_error(places[:20])).json()
    errors = [
        np.linalg.norm(np.array(estimate["position_mm"]) - place)
        for estimate, place in zip(reconstructed["estimates"], places[:20], strict=True)
    ]
    assert reconstructed["table_id"] == "sim-map"
    assert max(errors) < 0.2
    named = with_error(places[:20]) | {"calibration_id": "sim-nominal"}
    plain = client.post("/api/v1/reconstructions", json=named).json()
    assert plain["table_id"] is None
    without = [
        np.linalg.norm(np.array(estimate["position_mm"]) - place)
        for estimate, place in zip(plain["estimates"], places[:20], strict=True)
    ]
    assert np.mean(without) > 3.0 * np.mean(errors)


def with_error(places: np.ndarray) -> dict[str, Any]:
    """Readings of the bent sensors at places."""
    readings = CameraStack.of(simulated_sensor_models()).project(places)
    readings[:, 0] += [bent(place) for place in places]
    names = [model.name for model in simulated_sensor_models()]
    return {
        "device_id": "sim",
        "points": [
            {"name": f"Q{number}", "readings": dict(zip(names, row, strict=True))}
            for number, row in enumerate(readings.tolist())
        ],
    }


@pytest.mark.slow
def test_a_run_for_a_calibration_that_is_retired_meanwhile_stores_nothing(
    sqlite_client: Any, monkeypatch: pytest.MonkeyPatch
):
    gate = use_in_process_worker(monkeypatch, closed=True)
    sqlite_client.post("/api/v1/calibrations", json=NEW_CALIBRATIONS["frame"]["value"])
    body = BODY | {"calibration_id": "sim-frame"}
    assert sqlite_client.post(URL, json=body).status_code == 202
    sqlite_client.post("/api/v1/calibrations/sim-frame/retire")
    gate.set()
    found = wait(sqlite_client, "sim-map-run")
    assert found["problem"]["type"] == "/problems/calibration-retired"
    assert sqlite_client.get("/api/v1/correction-tables").json()["items"] == []
