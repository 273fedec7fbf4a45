"""A full disk: answered with 507 as what it is, and nothing is stored."""

import errno
from pathlib import Path
from typing import Any

import pytest
from psycopg.errors import DiskFull
from sqlalchemy import Connection, event
from sqlalchemy.exc import OperationalError

from service.database.engine import Database
from service.problems.errors import DatabaseFull

SOURCE = {"kind": "simulated"}


@pytest.fixture
def full_client(sqlite_client: Any) -> Any:
    """A client of a server whose database may not grow, as on a full disk."""

    def limit(connection: Connection) -> None:
        connection.exec_driver_sql("PRAGMA max_page_count = 1")  # as large as it is

    event.listen(sqlite_client.app.state.database.engine, "begin", limit)
    return sqlite_client


def test_database_on_a_full_disk_is_answered_with_507(full_client: Any) -> None:
    for number in range(200):
        body = {"id": f"b{number}", "title": "B" * 100, "source": SOURCE}
        answer = full_client.post("/api/v1/devices", json=body)
        if answer.status_code != 201:
            break
    assert (answer.status_code, answer.json()["type"]) == (507, "/problems/database-full")
    assert "locked" not in answer.json()["detail"]
    assert "retry-after" not in answer.headers
    assert full_client.get(f"/api/v1/devices/b{number}").status_code == 404


def test_database_of_postgresql_on_a_full_disk_raises_database_full(tmp_path: Path) -> None:
    database = Database(f"sqlite:///{tmp_path}/empty.sqlite3")
    with pytest.raises(DatabaseFull), database.read():
        raise OperationalError("INSERT", {}, DiskFull("could not extend file"))
    database.close()


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EDQUOT])
def test_file_on_a_full_disk_is_answered_with_507(
    sqlite_client: Any, monkeypatch: pytest.MonkeyPatch, code: int
) -> None:
    def write(*_: object, **__: object) -> None:
        raise OSError(code, "no room")

    monkeypatch.setattr(sqlite_client.app.state.device_service, "create", write, raising=True)
    answer = sqlite_client.post("/api/v1/devices", json={"id": "b", "title": "B", "source": SOURCE})
    assert (answer.status_code, answer.json()["type"]) == (507, "/problems/insufficient-storage")


def test_other_errors_of_files_stay_unexpected(
    sqlite_client: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    def write(*_: object, **__: object) -> None:
        raise OSError(errno.EIO, "secret")

    monkeypatch.setattr(sqlite_client.app.state.device_service, "create", write, raising=True)
    answer = sqlite_client.post("/api/v1/devices", json={"id": "b", "title": "B", "source": SOURCE})
    assert (answer.status_code, answer.json()["type"]) == (500, "/problems/internal-error")
    assert "secret" not in answer.text
