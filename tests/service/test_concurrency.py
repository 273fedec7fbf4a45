"""Requests at the same moment: one wins, the others are told; history stays one chain."""

from concurrent.futures import ThreadPoolExecutor
from concurrent.futures import TimeoutError as StillWaiting
from datetime import UTC, datetime
from threading import Event
from typing import Any

import pytest

from hardware.simulated.calibration_target import calibration_target_points_mm
from service.api.calibrations import store
from service.api.calibrations.examples import simulated_points
from service.api.devices.store import get_device
from service.database.models import CalibrationRow, DeviceRow
from service.pipeline.active_calibration import ActiveCalibration
from service.problems.errors import CalibrationRetired

pytestmark = pytest.mark.slow  # threads and servers against each other

THREADS = 8
A_WHILE_S = 0.3
"""Long enough for another thread to reach the lock at which it has to wait."""


def at_once(requests: list[Any]) -> list[Any]:
    with ThreadPoolExecutor(THREADS) as pool:
        return [done.result() for done in [pool.submit(request) for request in requests]]


def test_activations_make_one_chain_that_ends_where_the_live_side_is(client: Any, live: Any):
    points = simulated_points(2.0 * calibration_target_points_mm()[::2])
    for name in ("a", "b"):
        body = {"id": name, "device_id": "sim", "points": points}
        assert client.post("/api/v1/calibrations", json=body).status_code == 201
    names = ["a", "b", "sim-nominal"] * THREADS
    answers = at_once(
        [lambda name=name: client.post(f"/api/v1/calibrations/{name}/activate") for name in names]
    )
    statuses = [answer.status_code for answer in answers]
    assert set(statuses) <= {200, 409}
    assert 200 in statuses
    assert {answer.json()["type"] for answer in answers if answer.status_code == 409} <= {
        "/problems/activation-conflict"
    }
    told = client.get("/api/v1/audit?operation=activate-calibration&limit=200").json()["items"]
    assert sorted(entry["outcome"] for entry in told) == sorted(
        "done" if status == 200 else "refused" for status in statuses
    )
    history = client.get("/api/v1/devices/sim/activations?limit=200").json()["items"][::-1]
    previous = None
    for move in history:
        assert move["previous_calibration_id"] == previous
        assert move["calibration_id"] != previous
        previous = move["calibration_id"]
    assert client.get("/api/v1/devices/sim").json()["active_calibration_id"] == previous
    assert [call[2] for call in live.calls if call[0] == "calibration"][-1] == previous
    active = client.get("/api/v1/calibrations?state=active").json()["items"]
    assert [item["id"] for item in active] == [previous]


def test_one_of_many_gets_the_id(client: Any):
    points = [
        {"name": point["name"], "readings": point["readings"]}
        for point in simulated_points([[0.0, 0.0, 0.0]])
    ]
    device = {
        "id": "new",
        "title": "New",
        "source": {
            "kind": "external",
            "sensors": [{"name": "A", "pixels": 1024, "pitch_um": 7.0}],
        },
    }
    for path, body in (
        ("/api/v1/devices", device),
        ("/api/v1/reconstructions", {"id": "new", "device_id": "sim", "points": points}),
    ):
        answers = at_once(
            [lambda path=path, body=body: client.post(path, json=body) for _ in range(THREADS)]
        )
        statuses = sorted(answer.status_code for answer in answers)
        assert statuses == [201] + [409] * (THREADS - 1)


def test_a_calibration_retired_at_the_same_moment_is_not_active(client: Any):
    points = simulated_points(2.0 * calibration_target_points_mm()[::2])
    for number in range(4):
        name = f"c{number}"
        client.post("/api/v1/calibrations", json={"id": name, "device_id": "sim", "points": points})
        activated, retired = at_once(
            [
                lambda name=name: client.post(f"/api/v1/calibrations/{name}/activate"),
                lambda name=name: client.post(f"/api/v1/calibrations/{name}/retire"),
            ]
        )
        assert sorted([activated.status_code, retired.status_code]) == [200, 409]
        state = client.get(f"/api/v1/calibrations/{name}").json()["state"]
        assert state == ("active" if activated.status_code == 200 else "retired")


def test_a_second_activation_waits_until_the_first_is_live(
    client: Any, live: Any, monkeypatch: pytest.MonkeyPatch
):
    points = simulated_points(2.0 * calibration_target_points_mm()[::2])
    for name in ("a", "b"):
        body = {"id": name, "device_id": "sim", "points": points}
        client.post("/api/v1/calibrations", json=body)
    entered, go = Event(), Event()
    record = live.set_calibration

    def slow_for_a(device_id: str, found: ActiveCalibration) -> None:
        if found.calibration_id == "a":
            entered.set()
            assert go.wait(240.0)
        record(device_id, found)

    monkeypatch.setattr(live, "set_calibration", slow_for_a)
    with ThreadPoolExecutor(2) as pool:
        first = pool.submit(client.post, "/api/v1/calibrations/a/activate")
        assert entered.wait(240.0)
        second = pool.submit(client.post, "/api/v1/calibrations/b/activate")
        with pytest.raises(StillWaiting):
            second.result(A_WHILE_S)
        go.set()
        assert (first.result(10).status_code, second.result(10).status_code) == (200, 200)
    assert [call[2] for call in live.calls if call[0] == "calibration"] == ["a", "b"]
    assert client.get("/api/v1/devices/sim").json()["active_calibration_id"] == "b"


def test_activating_sees_a_retirement_that_came_first(client: Any):
    points = simulated_points(2.0 * calibration_target_points_mm()[::2])
    client.post("/api/v1/calibrations", json={"id": "a", "device_id": "sim", "points": points})
    database = client.app.state.database

    def activate() -> None:
        with database.write() as session:
            store.activate(session, "a")

    with ThreadPoolExecutor(1) as pool:
        with database.write() as session:
            get_device(session, "sim", lock=True)
            session.get_one(CalibrationRow, "a").retired_at = datetime.now(UTC)
            session.flush()
            waiting = pool.submit(activate)
            with pytest.raises(StillWaiting):
                waiting.result(A_WHILE_S)
        with pytest.raises(CalibrationRetired):
            waiting.result(10)


def test_an_id_taken_in_a_transaction_under_way_is_a_conflict(client: Any):
    now = datetime.now(UTC)
    other = DeviceRow(
        id="new", title="", source={}, sensors=[], autostart=False, created_at=now, updated_at=now
    )
    body = {"id": "new", "title": "New", "source": {"kind": "simulated"}}
    with ThreadPoolExecutor(1) as pool:
        with client.app.state.database.write() as session:
            session.add(other)
            session.flush()
            waiting = pool.submit(client.post, "/api/v1/devices", json=body)
            with pytest.raises(StillWaiting):
                waiting.result(A_WHILE_S)
        refused = waiting.result(10)
    assert (refused.status_code, refused.json()["type"]) == (409, "/problems/device-exists")
