"""A database that does not answer: 503 with nothing of its error, and devices stop all the same."""

import logging
import socket
import sqlite3
from collections.abc import Iterator
from typing import Any

import anyio
import httpx
import pytest
from anyio import fail_after
from anyio.to_thread import current_default_thread_limiter
from sqlalchemy.exc import InterfaceError, OperationalError
from sqlalchemy.exc import TimeoutError as NoFreeConnection

from service.application.app import create_app
from service.database import engine as engine_module
from service.database.engine import Database
from service.problems.errors import NotReady
from service.settings import Settings
from tests.service.fake_pipeline import FakePipeline, TestClient

SECRET = "hunter2"


def unreachable() -> Database:
    """A PostgreSQL server on a port where nobody listens."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    return Database(f"postgresql+psycopg://user:{SECRET}@127.0.0.1:{port}/there")


@pytest.fixture
def cut_off(sqlite_client: Any) -> Iterator[Any]:
    """A client of an application whose database went away after its start."""
    database = sqlite_client.app.state.database
    before, gone = database.engine, unreachable()
    database.engine = database._writer = gone.engine
    yield sqlite_client
    database.engine = before
    gone.close()


def assert_not_ready(answer: Any) -> None:
    problem = answer.json()
    assert (answer.status_code, problem["type"]) == (503, "/problems/not-ready")
    assert int(answer.headers["retry-after"]) > 0
    assert problem["context"] == {"part": "database"}
    for secret in (SECRET, "127.0.0.1", "user", "SELECT"):
        assert secret not in answer.text


@pytest.mark.parametrize(
    ("method", "path", "body"),
    [
        ("GET", "/api/v1/devices", None),
        ("GET", "/api/v1/devices/sim", None),
        ("GET", "/api/v1/devices/sim/state", None),
        ("PATCH", "/api/v1/devices/sim", {"title": "New"}),
        ("DELETE", "/api/v1/devices/sim", None),
        ("POST", "/api/v1/devices/sim/start", None),
        ("POST", "/api/v1/devices", {"id": "b", "title": "B", "source": {"kind": "simulated"}}),
        ("GET", "/api/v1/calibrations", None),
        ("POST", "/api/v1/calibrations/sim-nominal/activate", None),
        ("GET", "/api/v1/reconstructions", None),
        ("GET", "/readyz", None),
    ],
)
def test_requests_that_need_it_are_told_to_come_again(
    cut_off: Any, method: str, path: str, body: Any
):
    assert_not_ready(cut_off.request(method, path, json=body))


def test_the_log_says_what_the_database_said(cut_off: Any, caplog: pytest.LogCaptureFixture):
    with caplog.at_level(logging.ERROR):
        cut_off.get("/api/v1/devices")
    assert "refused" in caplog.text
    assert SECRET not in caplog.text


def test_a_running_device_is_stopped(cut_off: Any, live: FakePipeline):
    assert live.status("sim").state == "running"
    answer = cut_off.post("/api/v1/devices/sim/stop")
    assert (answer.status_code, answer.json()["state"]) == (200, "stopped")
    assert live.calls[-1] == ("stop", "sim")
    # Whether there is such a device only the database knows.
    assert_not_ready(cut_off.post("/api/v1/devices/nobody/stop"))


def test_a_file_that_another_process_has_locked(
    sqlite_settings: Settings, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(engine_module, "_BUSY_TIMEOUT_MS", 20)
    app = create_app(sqlite_settings, FakePipeline())
    with TestClient(app, raise_server_exceptions=False) as client:
        path = sqlite_settings.effective_database_url.removeprefix("sqlite:///")
        other = sqlite3.connect(path, isolation_level=None)
        other.execute("BEGIN IMMEDIATE")
        change = {"title": "New"}
        assert_not_ready(client.patch("/api/v1/devices/sim", json=change))
        assert client.get("/api/v1/devices/sim").status_code == 200
        other.execute("ROLLBACK")
        other.close()
        assert client.patch("/api/v1/devices/sim", json=change).status_code == 200


@pytest.mark.parametrize(
    "error",
    [
        OperationalError("SELECT 1", {}, Exception(SECRET)),
        InterfaceError("SELECT 1", {}, Exception(SECRET)),
        NoFreeConnection("QueuePool limit reached"),
    ],
)
def test_what_counts_as_no_answer(database_url: str, error: Exception):
    database = Database(database_url)
    try:
        for session in (database.read, database.write):
            with pytest.raises(NotReady) as caught, session():
                raise error
            assert SECRET not in caught.value.detail
    finally:
        database.close()


def test_health_needs_no_thread(sqlite_settings: Settings) -> None:
    async def ask() -> int:
        threads = current_default_thread_limiter()
        threads.total_tokens = 1
        async with threads:  # all of them wait for a database that hangs
            transport = httpx.ASGITransport(create_app(sqlite_settings))
            async with httpx.AsyncClient(transport=transport, base_url="http://127.0.0.1") as one:
                with fail_after(20.0):
                    return (await one.get("/healthz")).status_code

    assert anyio.run(ask) == 200
