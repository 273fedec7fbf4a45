"""Readiness: which part is not ready, and what keeps nobody from being served."""

import shutil
from types import SimpleNamespace
from typing import Any

import pytest
from sqlalchemy import text

from service.application.app import create_app
from service.application.server import MIN_FREE_BYTES, STUCK_AFTER_S
from service.pipeline.device_status import DeviceStatus
from service.pipeline.threads import ComputeThread
from service.settings import Settings
from tests.service.fake_pipeline import FakePipeline, TestClient


def part_of(client: Any) -> str:
    answer = client.get("/readyz")
    problem = answer.json()
    assert (answer.status_code, problem["type"]) == (503, "/problems/not-ready")
    assert client.get("/healthz").status_code == 200
    return str(problem["context"]["part"])


def test_a_compute_thread_that_is_stuck(sqlite_client: Any, live: FakePipeline):
    live.busy = STUCK_AFTER_S - 1.0
    assert sqlite_client.get("/readyz").status_code == 200
    live.busy = STUCK_AFTER_S + 1.0
    assert part_of(sqlite_client) == "live"


def test_a_compute_thread_tells_how_long_it_is_at_something():
    thread = ComputeThread()
    assert thread.submit(lambda: thread.busy_s).result() >= 0.0
    began = thread.submit(lambda: (thread.busy_s, thread.busy_s)).result()
    assert began[1] >= began[0] > 0.0
    thread.close()
    waiting = ComputeThread()
    assert waiting.busy_s == 0.0
    waiting.close()


def test_runs_that_nobody_takes(sqlite_client: Any):
    sqlite_client.app.state.runs.close()
    assert part_of(sqlite_client) == "runs"


def test_a_database_of_another_revision(client: Any):
    with client.app.state.database.engine.begin() as connection:
        connection.execute(text("UPDATE alembic_version SET version_num = '0001'"))
    assert part_of(client) == "database"
    assert "revision 0001" in client.get("/readyz").json()["detail"]


def test_a_disk_without_room(sqlite_client: Any, monkeypatch: pytest.MonkeyPatch):
    def with_free(free: int) -> None:
        monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=free))

    limit = sqlite_client.app.state.recordings.free_bytes
    with_free(limit)
    assert sqlite_client.get("/readyz").json()["limits"] == []
    with_free(limit - 1)
    [limited] = sqlite_client.get("/readyz").json()["limits"]
    assert "recordings" in limited
    with_free(MIN_FREE_BYTES - 1)
    assert part_of(sqlite_client) == "disk"


def test_a_folder_that_is_gone(sqlite_client: Any, sqlite_settings: Settings):
    sqlite_settings.folders.recordings.rmdir()
    assert part_of(sqlite_client) == "disk"


def test_all_that_is_wrong_is_told(sqlite_client: Any, live: FakePipeline):
    live.answers = False
    sqlite_client.app.state.runs.close()
    detail = sqlite_client.get("/readyz").json()["detail"]
    assert "live pipeline" in detail
    assert "runs" in detail


def test_a_device_that_failed_is_listed_for_who_may_know(
    sqlite_settings: Settings, live: FakePipeline
):
    live.states["bar"] = DeviceStatus("failed", "no such port")
    live.states["other"] = DeviceStatus("running")
    with TestClient(create_app(sqlite_settings, live)) as here:
        answer = here.get("/readyz").json()
        assert (answer["failed_devices"], answer["failed"]) == (1, ["bar"])
        far = TestClient(here.app, client=("192.0.2.1", 5))
        answer = far.get("/readyz").json()
        assert (answer["failed_devices"], answer["failed"]) == (1, None)
