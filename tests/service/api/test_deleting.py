"""What nothing refers to can be deleted; what something refers to is kept, and named."""

from typing import Any

import pytest

from hardware.recording.writer import RecordingWriter
from hardware.simulated.calibration_target import calibration_target_points_mm
from hardware.simulated.driver import SimulatedDriver
from hardware.simulated.settings import SimulationSettings
from service.api.calibrations.examples import simulated_points
from service.api.radiometric_calibrations.examples import NEW_RADIOMETRIC_CALIBRATIONS
from service.database.models import CalibrationRow
from service.settings import Settings
from tests.service.api.tools.test_tools_api import PATIENT, POINTER

API = "/api/v1"
READINGS = {"device_id": "sim", "points": [{"name": "a", "readings": {}}]}


def code(answer: Any) -> tuple[int, str]:
    return answer.status_code, answer.json()["type"].removeprefix("/problems/")


def referrers(answer: Any, problem: str) -> Any:
    assert code(answer) == (409, problem), answer.text
    found = answer.json()["context"]["referrers"]
    for kind, ids in found.items():
        assert kind.removesuffix("s") in answer.json()["detail"]
        for one in ids:
            assert one in answer.json()["detail"]
    return found


def new_calibration(client: Any, name: str = "mistake") -> None:
    points = simulated_points(calibration_target_points_mm())
    body = {"id": name, "device_id": "sim", "points": points}
    assert client.post(f"{API}/calibrations", json=body).status_code == 201


@pytest.mark.slow
def test_calibration_that_nothing_refers_to_is_deleted(client: Any) -> None:
    new_calibration(client)
    assert client.delete(f"{API}/calibrations/mistake").status_code == 204
    assert client.get(f"{API}/calibrations/mistake").status_code == 404
    assert code(client.delete(f"{API}/calibrations/mistake")) == (404, "unknown-calibration")


@pytest.mark.slow
def test_calibration_that_was_active_is_kept(client: Any) -> None:
    new_calibration(client)
    client.post(f"{API}/calibrations/mistake/activate").raise_for_status()
    client.post(f"{API}/calibrations/sim-nominal/activate").raise_for_status()
    found = referrers(client.delete(f"{API}/calibrations/mistake"), "calibration-in-use")
    assert found.keys() == {"activations"}
    assert client.post(f"{API}/calibrations/mistake/retire").json()["state"] == "retired"


@pytest.mark.slow
def test_calibration_of_a_reconstruction_is_kept_until_that_is_deleted(client: Any) -> None:
    new_calibration(client)
    body = {**READINGS, "id": "walk", "calibration_id": "mistake"}
    client.post(f"{API}/reconstructions", json=body).raise_for_status()
    found = referrers(client.delete(f"{API}/calibrations/mistake"), "calibration-in-use")
    assert found == {"reconstructions": ["walk"]}
    assert client.delete(f"{API}/reconstructions/walk").status_code == 204
    assert client.delete(f"{API}/calibrations/mistake").status_code == 204


@pytest.mark.slow
def test_parent_of_an_updated_calibration_is_kept(client: Any) -> None:
    new_calibration(client, "parent")
    with client.app.state.database.write() as session:
        row = session.get(CalibrationRow, "parent")
        values = {column.key: getattr(row, column.key) for column in row.__table__.columns}
        content = {**row.content, "parent": {"id": "parent", "content_hash": "0"}}
        session.add(CalibrationRow(**values | {"id": "child", "content": content}))
    found = referrers(client.delete(f"{API}/calibrations/parent"), "calibration-in-use")
    assert found == {"calibrations": ["child"]}


def test_radiometric_calibration(client: Any) -> None:
    path = f"{API}/radiometric-calibrations"
    for example in NEW_RADIOMETRIC_CALIBRATIONS.values():
        assert client.post(path, json=example["value"]).status_code == 201
    client.post(f"{path}/sim-radiometric/activate").raise_for_status()
    refused = client.delete(f"{path}/sim-radiometric")
    found = referrers(refused, "radiometric-calibration-in-use")
    assert found.keys() == {"activations"}
    assert client.delete(f"{path}/sim-radiometric-spare").status_code == 204
    assert len(client.get(path).json()["items"]) == 1


def test_tool_names_all_that_refer_to_it(client: Any) -> None:
    client.post(f"{API}/tools", json=PATIENT).raise_for_status()
    client.post(f"{API}/tools", json=POINTER | {"reference_id": "patient"}).raise_for_status()
    hold = {
        "id": "head",
        "device_id": "sim",
        "title": "Head",
        "watch": {"kind": "tool", "tool_id": "patient", "target_mm": [0, -80, 0]},
        "limits": {"shift_mm": 1.5},
    }
    client.post(f"{API}/beam-holds", json=hold).raise_for_status()
    found = referrers(client.delete(f"{API}/tools/patient"), "tool-in-use")
    assert found == {"holds": ["head"], "tools": ["pointer"]}
    client.delete(f"{API}/beam-holds/head").raise_for_status()
    client.delete(f"{API}/tools/pointer").raise_for_status()
    assert client.delete(f"{API}/tools/patient").status_code == 204


def test_device_names_five_of_many(client: Any) -> None:
    for number in range(7):
        body = {**READINGS, "id": f"walk-{number}"}
        client.post(f"{API}/reconstructions", json=body).raise_for_status()
    answer = client.delete(f"{API}/devices/sim")
    found = referrers(answer, "device-in-use")
    assert found["reconstructions"] == [f"walk-{number}" for number in range(5)]
    assert (
        '7 reconstructions ("walk-0", "walk-1", "walk-2", "walk-3", "walk-4", ...)'
        in answer.json()["detail"]
    )
    assert client.delete(f"{API}/devices/sim?cascade=true").status_code == 204


@pytest.mark.parametrize("running", [False, True])
def test_recording_of_a_device_is_kept(
    sqlite_client: Any, sqlite_settings: Settings, running: bool
) -> None:
    described = SimulatedDriver("sim", SimulationSettings()).description
    with RecordingWriter(sqlite_settings.folders.recordings / "walk.h5", described):
        pass
    source = {"kind": "replay", "recording_id": "walk.h5"}
    body = {"id": "again", "title": "Again", "source": source}
    made = sqlite_client.post(f"{API}/devices", json=body)
    assert made.status_code == 201, made.text
    if running:
        sqlite_client.post(f"{API}/devices/again/start").raise_for_status()
    found = referrers(sqlite_client.delete(f"{API}/recordings/walk.h5"), "recording-in-use")
    assert found == {"devices": ["again"]}
    sqlite_client.delete(f"{API}/devices/again").raise_for_status()
    assert sqlite_client.delete(f"{API}/recordings/walk.h5").status_code == 204
