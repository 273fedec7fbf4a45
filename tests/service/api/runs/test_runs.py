"""Runs: posted, followed, cancelled, and what becomes of them when the server ends."""

import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sqlalchemy import delete

from service.api.calibrations.examples import NEW_CALIBRATIONS, simulated_points
from service.api.runs.kind_registry import KINDS, RunKind
from service.application.app import create_app
from service.database import gateway
from service.database.engine import Database
from service.database.gateway import Gateway
from service.database.models import GatewayRow, RunRow
from service.jobs import run_manager, store
from service.settings import Settings
from tests.service.api.runs.in_process_worker import use_in_process_worker
from tests.service.fake_pipeline import FakePipeline, TestClient
from tests.service.jobs import slow_tasks

URL = "/api/v1/runs/calibration"
FRAME = NEW_CALIBRATIONS["frame"]["value"]["points"]
QUICK = {"distortion": "none", "labels": "off"}
"""For runs of which it does not matter what they look for."""


def body(**changes: Any) -> dict[str, Any]:
    return {"device_id": "sim", "points": FRAME} | changes


def wait(client: Any, run: str, until: Callable[[Any], bool] | None = None) -> Any:
    """Follow a run to its end, or until it is as is asked."""
    end = time.monotonic() + 240.0
    while True:
        found = client.get(f"/api/v1/runs/{run}").json()
        if found["state"] not in store.OPEN or (until is not None and until(found)):
            return found
        assert time.monotonic() < end, found
        time.sleep(0.02)


def started(found: Any) -> bool:
    return bool(found["stage"] == "waits")


@pytest.fixture
def computing(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Let calibration runs compute something else."""

    def use(function: Callable[..., Any], *arguments: Any) -> None:
        kind = KINDS["calibration"]
        other = RunKind(lambda session, row: (function, arguments), kind.store, kind.results)
        monkeypatch.setitem(KINDS, "calibration", other)

    return use


@pytest.fixture
def open_client(settings: Settings) -> Iterator[Callable[[], TestClient]]:
    """Servers over one database, one after the other."""

    def make() -> TestClient:
        return TestClient(create_app(settings, FakePipeline()), raise_server_exceptions=False)

    return make


@pytest.mark.slow
def test_a_run_makes_the_calibration_that_a_request_makes(client: Any):
    posted = client.post(URL, json=body(id="first", result_id="made", note="by a run"))
    assert posted.status_code == 202
    assert posted.headers["location"] == "/api/v1/runs/first"
    assert posted.json()["state"] == "queued"
    found = wait(client, "first")
    assert (found["state"], found["progress"], found["problem"]) == ("succeeded", 1.0, None)
    assert found["result_path"] == "/api/v1/calibrations/made"
    made = client.get(found["result_path"]).json()
    same = client.post("/api/v1/calibrations", json=body(distortion="auto")).json()
    assert made["note"] == "by a run"
    assert made["state"] == "available"
    models = [fit["model"] for fit in made["result"]["sensors"]]
    others = [fit["model"] for fit in same["result"]["sensors"]]
    for one, other in zip(models, others, strict=True):
        assert one["principal_distance_px"] == pytest.approx(other["principal_distance_px"])
    # What a run makes is the doing of whoever posted it.
    (entry,) = client.get("/api/v1/audit", params={"object_id": "made"}).json()["items"]
    assert (entry["actor"]["kind"], entry["operation"]) == ("local", "create-calibration-run")
    assert entry["request_id"] == posted.headers["x-request-id"]
    listed = client.get("/api/v1/runs", params={"device_id": "sim", "kind": "calibration"}).json()
    assert [run["id"] for run in listed["items"]] == ["first"]
    assert client.get("/api/v1/runs", params={"state": "failed"}).json()["items"] == []


def test_a_run_that_has_ended_is_deleted(client: Any, computing: Any, tmp_path: Path):
    computing(slow_tasks.wait_for_end, str(tmp_path / "pid"))
    client.post(URL, json=body(id="old"))
    refused = client.delete("/api/v1/runs/old")
    assert refused.status_code == 409
    assert refused.json()["type"] == "/problems/run-not-ended"
    assert "cancel it first" in refused.json()["detail"]
    client.post("/api/v1/runs/old/cancel")
    assert client.delete("/api/v1/runs/old").status_code == 204
    assert client.get("/api/v1/runs/old").status_code == 404


def test_an_id_that_another_run_is_to_store_under_is_taken(
    sqlite_client: Any, computing: Any, tmp_path: Path
):
    client = sqlite_client
    computing(slow_tasks.wait_for_end, str(tmp_path / "pid"))
    for number, expected in enumerate((202, 409)):
        posted = client.post(URL, json=body(id=f"run-{number}", result_id="made"))
        assert posted.status_code == expected, posted.text
    assert posted.json()["type"] == "/problems/calibration-exists"
    assert 'run "run-0" is to make calibration "made"' in posted.json()["detail"]
    client.post("/api/v1/runs/run-0/cancel")
    posted = client.post(URL, json=body(id="run-2", result_id="made"))
    assert posted.status_code == 202, posted.text
    client.post("/api/v1/runs/run-2/cancel")


def test_many_points_are_left_out_in_blocks(sqlite_client: Any, monkeypatch: pytest.MonkeyPatch):
    use_in_process_worker(monkeypatch)
    points = simulated_points(np.random.default_rng(5).uniform(-120, 120, (101, 3)))
    posted = sqlite_client.post(URL, json=body(id="many", points=points, **QUICK))
    assert posted.status_code == 202, posted.text
    made = sqlite_client.get(wait(sqlite_client, "many")["result_path"]).json()
    assert made["errors"]["leave_one_out"] is None
    [blocks] = made["result"]["cross_validation"]
    assert (blocks["scheme"], blocks["errors"]["points"]) == ("blocks", 101)
    assert made["result"]["diagnosis"]["sensors"][0]["sensor"] == "vertical"
    assert made["result"]["settings"]["distortion"] == "none"


def test_a_failed_run_has_the_problem_of_its_error(sqlite_client: Any, computing: Any):
    computing(slow_tasks.fail)
    sqlite_client.post(URL, json=body(id="failing"))
    found = wait(sqlite_client, "failing")
    assert found["state"] == "failed"
    assert found["problem"]["type"] == "/problems/no-convergence"
    assert found["problem"]["detail"] == "it ran away"
    assert found["problem"]["context"] == {"sensor": "left"}
    assert found["result_path"] is None


def test_an_unexpected_error_is_for_the_log(sqlite_client: Any, computing: Any, caplog: Any):
    computing(slow_tasks.break_down)
    sqlite_client.post(URL, json=body(id="broken"))
    problem = wait(sqlite_client, "broken")["problem"]
    assert problem["type"] == "/problems/internal-error"
    assert "secret" not in problem["detail"]
    reference = problem["detail"].rpartition(" ")[2]
    assert any(reference in one.message and "secret" in one.message for one in caplog.records)


def test_a_process_that_dies_fails_its_run(sqlite_client: Any, computing: Any):
    computing(slow_tasks.die)
    sqlite_client.post(URL, json=body(id="dead"))
    found = wait(sqlite_client, "dead")
    assert found["problem"]["type"] == "/problems/worker-ended"
    assert "exit code 7" in found["problem"]["detail"]


def test_run_whose_process_is_ended_by_sigterm_is_interrupted_and_the_next_one_waits(
    sqlite_settings: Settings, computing: Any
):
    """The signal went to all of the server's processes; the server itself takes longer."""
    computing(slow_tasks.end_by_sigterm)
    with TestClient(create_app(sqlite_settings, FakePipeline())) as client:
        client.post(URL, json=body(id="first"))
        client.post(URL, json=body(id="second"))
        found = wait(client, "first")
        assert (found["state"], found["problem"]) == ("interrupted", None)
        assert found["stage"] == "the server was stopped; post it again"
    database = Database(sqlite_settings.effective_database_url)
    try:
        with database.read() as session:
            assert session.get_one(RunRow, "second").state == "queued"
    finally:
        database.close()


@pytest.mark.slow
def test_cancelling_ends_the_process_and_stores_nothing(
    client: Any, computing: Any, tmp_path: Path
):
    computing(slow_tasks.wait_for_end, str(tmp_path / "pid"))
    client.post(URL, json=body(id="endless", result_id="never"))
    found = wait(client, "endless", started)
    assert (found["state"], found["progress"]) == ("running", 0.25)
    pid = int((tmp_path / "pid").read_text())
    cancelled = client.post("/api/v1/runs/endless/cancel")
    assert cancelled.json()["state"] == "cancelled"
    wait_until(lambda: not running(pid))
    assert client.get("/api/v1/runs/endless").json()["state"] == "cancelled"
    assert client.get("/api/v1/calibrations/never").status_code == 404
    again = client.post("/api/v1/runs/endless/cancel")
    assert (again.status_code, again.json()["state"]) == (200, "cancelled")


@pytest.mark.slow
def test_runs_wait_for_their_turn(sqlite_client: Any, computing: Any, tmp_path: Path):
    computing(slow_tasks.wait_for_end, str(tmp_path / "pid"))
    sqlite_client.post(URL, json=body(id="first"))
    wait(sqlite_client, "first", started)
    sqlite_client.post(URL, json=body(id="second"))
    sqlite_client.post(URL, json=body(id="third"))
    time.sleep(0.3)
    states = {run["id"]: run["state"] for run in sqlite_client.get("/api/v1/runs").json()["items"]}
    assert states == {"first": "running", "second": "queued", "third": "queued"}
    assert sqlite_client.post("/api/v1/runs/second/cancel").json()["state"] == "cancelled"
    sqlite_client.post("/api/v1/runs/first/cancel")
    wait(sqlite_client, "third", started)


@pytest.mark.slow
def test_more_runs_than_may_wait_are_refused(sqlite_settings: Settings, computing: Any, tmp_path):
    computing(slow_tasks.wait_for_end, str(tmp_path / "pid"))
    settings = sqlite_settings.model_copy(update={"runs_waiting": 1})
    with TestClient(create_app(settings, FakePipeline())) as client:
        client.post(URL, json=body(id="first"))
        wait(client, "first", started)
        assert client.post(URL, json=body(id="second")).status_code == 202
        refused = client.post(URL, json=body(id="third"))
        assert (refused.status_code, refused.json()["type"]) == (503, "/problems/busy")
        assert client.get("/api/v1/runs/third").status_code == 404


@pytest.mark.slow
def test_what_ran_when_the_server_stopped_is_interrupted_and_what_waited_goes_on(
    open_client: Any, computing: Any, tmp_path: Path
):
    computing(slow_tasks.wait_for_end, str(tmp_path / "pid"))
    with open_client() as client:
        client.post(URL, json=body(id="first"))
        wait(client, "first", started)
        client.post(URL, json=body(id="second"))
        pid = int((tmp_path / "pid").read_text())
    assert not running(pid)
    computing(slow_tasks.fail)
    with open_client() as client:
        assert client.get("/api/v1/runs/first").json()["state"] == "interrupted"
        assert wait(client, "second")["problem"]["type"] == "/problems/no-convergence"


def living_gateway(name: str) -> GatewayRow:
    now = datetime.now(UTC)
    return GatewayRow(
        id=name, name=name, host="h", process_id=1, directory_id="d", beat=0, started_at=now,
        heartbeat_at=now,
    )  # fmt: skip


def test_what_ran_when_the_server_died_is_interrupted(
    open_client: Any, settings: Settings, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(gateway, "DEAD_AFTER_S", 1e9)
    with open_client():
        pass
    database = Database(settings.effective_database_url)
    try:
        with database.write() as session:
            for name, own in (("dead", True), ("elsewhere", False)):
                row = store.add_run(session, "calibration", "sim", {}, 10, name)
                server = Gateway()
                assert store.claim(session, server) is row
                # Of this machine with the id of a process that is no more, and of another machine.
                host = server.id.rpartition("/")[0]
                row.owner = f"{host}/{2**22 + 1}" if own else "elsewhere/1"
            if database.engine.dialect.name == "postgresql":  # whose servers know each other
                session.add(living_gateway("elsewhere/1"))
    finally:
        database.close()
    with open_client() as client:
        assert client.get("/api/v1/runs/dead").json()["state"] == "interrupted"
        assert client.get("/api/v1/runs/elsewhere").json()["state"] == "running"
        with client.app.state.database.write() as session:
            session.get_one(RunRow, "elsewhere").heartbeat_at -= store.STALE_AFTER
            session.execute(delete(GatewayRow).where(GatewayRow.id == "elsewhere/1"))
        client.app.state.runs.submitted()  # it would look in some seconds
        wait(client, "elsewhere")
        assert client.get("/api/v1/runs/elsewhere").json()["state"] == "interrupted"


def test_run_that_is_computed_here_with_a_stale_heartbeat_goes_on(
    sqlite_client: Any, monkeypatch: pytest.MonkeyPatch
):
    """As behind a suspend of the machine: the dispatcher looks before the run is heard of."""
    monkeypatch.setattr(run_manager, "_HEARTBEAT_S", 1e6)
    gate = use_in_process_worker(monkeypatch, closed=True)
    sqlite_client.post(URL, json=body(id="own", **QUICK))
    wait(sqlite_client, "own", lambda found: found["state"] == "running")
    with sqlite_client.app.state.database.write() as session:
        session.get_one(RunRow, "own").heartbeat_at -= 2 * store.STALE_AFTER
        row = store.add_run(session, "calibration", "sim", {}, 10, "elsewhere")
        assert store.claim(session, Gateway()) is row
        row.owner = "elsewhere/1"
        row.heartbeat_at -= 2 * store.STALE_AFTER
    sqlite_client.app.state.runs.submitted()
    assert wait(sqlite_client, "elsewhere")["state"] == "interrupted"
    assert sqlite_client.get("/api/v1/runs/own").json()["state"] == "running"
    gate.set()
    assert wait(sqlite_client, "own")["state"] == "succeeded"


@pytest.mark.slow
def test_a_deleted_device_ends_its_runs(sqlite_client: Any, computing: Any, tmp_path: Path):
    computing(slow_tasks.wait_for_end, str(tmp_path / "pid"))
    sqlite_client.post(URL, json=body(id="first"))
    wait(sqlite_client, "first", started)
    pid = int((tmp_path / "pid").read_text())
    assert sqlite_client.delete("/api/v1/devices/sim?cascade=true").status_code == 204
    assert sqlite_client.get("/api/v1/runs/first").status_code == 404
    wait_until(lambda: not running(pid))


@pytest.mark.slow
def test_a_result_id_taken_meanwhile_fails_the_run(
    sqlite_client: Any, monkeypatch: pytest.MonkeyPatch
):
    gate = use_in_process_worker(monkeypatch, closed=True)
    sqlite_client.post(URL, json=body(id="first", result_id="same", **QUICK))
    made = sqlite_client.post("/api/v1/calibrations", json=body(id="same"))
    assert made.status_code == 201
    gate.set()
    found = wait(sqlite_client, "first")
    assert found["problem"]["type"] == "/problems/calibration-exists"


def running(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):  # the latter: it ended while this was read
        return False


def wait_until(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + 240.0
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.02)
