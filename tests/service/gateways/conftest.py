"""Fixtures: two real servers on one PostgreSQL database."""

import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final

import httpx
import pytest

from service.database.engine import Database
from tests.service.conftest import postgres_schema
from tests.service.crash.process import ServiceProcess

WAIT_S: Final = 240.0
SLOW: Final = "tests.service.gateways.slow_server"


class Pair:
    """Servers ``a``, which was first and has the devices, and ``b``."""

    def __init__(self, folder: Path, url: str, *, share_files: bool = False, **settings: object):
        common = folder / "common" if share_files else None
        self.database = Database(url)
        self.a = ServiceProcess(folder / "a", url, common, SLOW, **settings)
        self.b = ServiceProcess(folder / "b", url, common, SLOW, **settings)
        self.processes = (self.a, self.b)

    def start(self) -> None:
        for one in self.processes:
            one.start()

    def stop(self) -> None:
        for one in self.processes:
            one.stop()
        self.database.close()

    def name(self, process: ServiceProcess) -> str:
        """The name that a gateway has."""
        return f"{os.uname().nodename}:{process.port}"

    def rows(self, query: str) -> list[Any]:
        """What the database has."""
        with self.database.engine.connect() as connection:
            return list(connection.exec_driver_sql(query).all())


def ask(process: ServiceProcess, method: str, path: str, body: Any = None, **headers: str) -> Any:
    """The answer of a gateway."""
    sent = {name.replace("_", "-"): value for name, value in headers.items()}
    url = f"{process.url}/api/v1{path}"
    return httpx.request(method, url, json=body, headers=sent, timeout=WAIT_S)


def done(process: ServiceProcess, method: str, path: str, body: Any = None, **headers: str) -> Any:
    """The document that a gateway answers, which does as it is asked."""
    answer = ask(process, method, path, body, **headers)
    assert answer.is_success, answer.text
    return answer.json() if answer.content else None


def code(answer: httpx.Response) -> tuple[int, str]:
    """Status and problem of an answer."""
    return answer.status_code, answer.json().get("type", "").rpartition("/")[2]


def wait_for(condition: Callable[[], Any]) -> Any:
    """Return what a condition becomes."""
    end = time.monotonic() + WAIT_S
    while not (found := condition()):
        assert time.monotonic() < end
        time.sleep(0.05)
    return found


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Pair]:
    """Two gateways that live as long as the tests of a module."""
    for url in postgres_schema():
        made = Pair(tmp_path_factory.mktemp("pair"), url, failed_logins_per_minute=5)
        try:
            made.start()
            yield made
        finally:
            made.stop()


@pytest.fixture
def new_pair(tmp_path: Path) -> Iterator[Pair]:
    """Two gateways for one test, not started."""
    for url in postgres_schema():
        made = Pair(tmp_path, url)
        try:
            yield made
        finally:
            made.stop()


@pytest.fixture
def sharing_pair(tmp_path: Path) -> Iterator[Pair]:
    """The same with one data directory."""
    for url in postgres_schema():
        made = Pair(tmp_path, url, share_files=True, recording_max_age_days=1)
        try:
            yield made
        finally:
            made.stop()
