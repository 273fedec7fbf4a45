"""Two who activate at once, and one who believes something else to be active: 409, and no move."""

from concurrent.futures import Future, ThreadPoolExecutor
from concurrent.futures import TimeoutError as StillWaiting
from typing import Any

import pytest

from hardware.simulated.calibration_target import calibration_target_points_mm
from service.api.beam_holds.monitor_config import tracking_config_of
from service.api.calibrations import store as calibrations
from service.api.calibrations.examples import simulated_points
from service.api.correction_tables.store import active_calibration
from service.api.devices.device_service import DeviceService, StoredContent
from service.api.devices.store import get_device
from service.api.radiometric_calibrations.store import active_radiometric
from service.database.engine import Database
from service.problems.errors import ActivationConflict
from service.settings import Settings
from tests.service.fake_pipeline import FakePipeline

A_WHILE_S = 0.3
"""Long enough for other threads to reach the lock at which they have to wait."""


@pytest.fixture
def with_two(client: Any) -> Any:
    points = simulated_points(2.0 * calibration_target_points_mm()[::2])
    for name in ("a", "b"):
        body = {"id": name, "device_id": "sim", "points": points}
        assert client.post("/api/v1/calibrations", json=body).status_code == 201
    return client


def wait_a_while(waiting: list[Future[Any]]) -> None:
    for one in waiting:
        with pytest.raises(StillWaiting):
            one.result(A_WHILE_S / len(waiting))


def activations(client: Any) -> list[str]:
    items = client.get("/api/v1/devices/sim/activations").json()["items"]
    return [item["calibration_id"] for item in items]


@pytest.mark.slow
def test_of_two_at_the_same_moment_one_wins_and_the_log_tells_both(with_two: Any):
    with ThreadPoolExecutor(2) as pool:
        with with_two.app.state.database.write() as session:
            get_device(session, "sim", lock=True)  # both have come before either can move
            waiting = [
                pool.submit(with_two.post, f"/api/v1/calibrations/{name}/activate")
                for name in ("a", "b")
            ]
            wait_a_while(waiting)
        answers = [one.result(10) for one in waiting]
    assert sorted(answer.status_code for answer in answers) == [200, 409]
    [won] = [answer.json()["id"] for answer in answers if answer.status_code == 200]
    [lost] = [answer.json() for answer in answers if answer.status_code == 409]
    assert lost["type"] == "/problems/activation-conflict"
    assert f'"{won}" now' in lost["detail"]
    assert activations(with_two) == [won, "sim-nominal"]
    told = with_two.get("/api/v1/audit?operation=activate-calibration").json()["items"]
    [done] = [entry for entry in told if entry["outcome"] == "done"]
    [refused] = [entry for entry in told if entry["outcome"] == "refused"]
    assert (done["object_id"], done["before"]["calibration_id"]) == ("sim", "sim-nominal")
    assert done["after"]["calibration_id"] == won
    assert refused["object_id"] == ({"a", "b"} - {won}).pop()
    assert refused["detail"] == lost["detail"]


@pytest.mark.slow
def test_of_two_servers_with_one_database_one_wins(with_two: Any, settings: Settings):
    # Each has locks of its own; what decides is the database's.
    others = [Database(settings.effective_database_url) for _ in range(2)]
    stored = StoredContent(active_calibration, active_radiometric, tracking_config_of)
    servers = [DeviceService(one, FakePipeline(), settings.folders, stored) for one in others]

    def activate(server: DeviceService, name: str) -> None:
        with server.pointer_move("sim", lambda now: now.calibration_id == name) as session:
            calibrations.activate(session, name)

    try:
        with ThreadPoolExecutor(2) as pool:
            with with_two.app.state.database.write() as session:
                get_device(session, "sim", lock=True)
                waiting = [
                    pool.submit(activate, server, name)
                    for server, name in zip(servers, ("a", "b"), strict=True)
                ]
                wait_a_while(waiting)
            errors = [one.exception(10) for one in waiting]
    finally:
        for one in others:
            one.close()
    [lost] = [error for error in errors if error is not None]
    assert isinstance(lost, ActivationConflict)
    assert len(activations(with_two)) == 2


@pytest.mark.slow
def test_two_roll_backs_at_once_go_back_once(with_two: Any):
    for name in ("a", "b"):
        assert with_two.post(f"/api/v1/calibrations/{name}/activate").status_code == 200
    with ThreadPoolExecutor(2) as pool:
        with with_two.app.state.database.write() as session:
            get_device(session, "sim", lock=True)
            waiting = [
                pool.submit(with_two.post, "/api/v1/devices/sim/roll-back") for _ in range(2)
            ]
            wait_a_while(waiting)
        statuses = sorted(one.result(10).status_code for one in waiting)
    assert statuses == [200, 409]
    assert activations(with_two) == ["a", "b", "a", "sim-nominal"]


@pytest.mark.slow
def test_a_client_says_what_it_believes_to_be_active(with_two: Any):
    path = "/api/v1/calibrations/{}/activate?expected={}"
    assert with_two.post(path.format("a", "sim-nominal")).status_code == 200
    refused = with_two.post(path.format("b", "sim-nominal"))
    assert refused.status_code == 409
    assert refused.json()["type"] == "/problems/activation-conflict"
    for part in ('"a"', '"sim-nominal"'):
        assert part in refused.json()["detail"]
    # Sent again, because the answer was lost: it is as it should be already.
    assert with_two.post(path.format("a", "sim-nominal")).status_code == 200
    assert activations(with_two) == ["a", "sim-nominal"]
    assert with_two.post("/api/v1/devices/sim/roll-back?expected=b").status_code == 409
    assert with_two.post("/api/v1/devices/sim/roll-back?expected=a").status_code == 200
