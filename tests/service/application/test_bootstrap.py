"""Failures at the start of `lumiline serve`: one line, no password, an exit code."""

import asyncio
import gc
import socket
import sqlite3
import weakref
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import text
from sqlalchemy.engine import make_url
from sqlalchemy.exc import OperationalError
from typer.testing import CliRunner

from service.cli import app
from service.cli.serve import collect_young, freeze_gc
from service.database.engine import Database
from service.database.migration import migrate

SECRET = "s3cret"


@pytest.fixture(autouse=True)
def nothing_set(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("LUMILINE_CONFIG", raising=False)
    monkeypatch.delenv("LUMILINE_DATABASE_URL", raising=False)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("LUMILINE_PORT", "0")
    monkeypatch.setattr("service.application.shutdown.run_server", lambda *_, **__: None)


def serve(data_dir: Path, monkeypatch: pytest.MonkeyPatch, database_url: str | None = None) -> Any:
    if database_url is not None:
        monkeypatch.setenv("LUMILINE_DATABASE_URL", database_url)
    return CliRunner().invoke(app, ["serve", "--data-dir", str(data_dir)])


def assert_one_line(result: Any, code: int, *words: str) -> None:
    assert isinstance(result.exception, SystemExit), result.exception
    assert result.exit_code == code
    [line] = result.output.splitlines()
    for word in ("error: ", *words):
        assert word in line
    assert SECRET not in line


@pytest.mark.slow
def test_what_can_start_is_prepared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    result = serve(tmp_path / "data", monkeypatch)
    assert (result.exit_code, result.output) == (0, "")
    with sqlite3.connect(tmp_path / "data" / "lumiline.sqlite3") as connection:
        assert connection.execute("SELECT id FROM devices").fetchall() == [("sim",)]
    connection.close()
    assert (tmp_path / "data" / "recordings").is_dir()


@pytest.mark.parametrize(
    "query", ["", f"?password={SECRET}"], ids=["password-in-place", "password-in-query"]
)
def test_a_server_that_refuses(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, query: str):
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    password = "" if query else f":{SECRET}"
    url = f"postgresql+psycopg://user{password}@127.0.0.1:{port}/there{query}"
    result = serve(tmp_path, monkeypatch, url)
    assert_one_line(result, 1, f"@127.0.0.1:{port}/there cannot be used", "refused")


@pytest.mark.postgres
@pytest.mark.parametrize("database_url", ["postgresql"], indirect=True)
def test_a_database_that_is_not_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, database_url: str
):
    url = make_url(database_url).set(database="nowhere", password=SECRET, query={})
    result = serve(tmp_path, monkeypatch, url.render_as_string(hide_password=False))
    assert_one_line(result, 1, "/nowhere cannot be used", 'database "nowhere" does not exist')


@pytest.mark.parametrize(
    ("setting", "host"),
    [("PORT", "127.0.0.1"), ("OPENIGTLINK_PORT", "localhost"), ("NDI_PORT", "127.0.0.1")],
)
def test_a_port_that_is_taken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, setting: str, host: str
):
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        monkeypatch.setenv(f"LUMILINE_{setting}", str(port))
        monkeypatch.setenv(f"LUMILINE_{setting.removesuffix('PORT')}HOST", host)
        result = serve(tmp_path, monkeypatch)
    assert_one_line(result, 3, f"setting {setting.lower()}: ", f"port {port}", "another program")


@pytest.mark.parametrize("protocol", ["openigtlink", "ndi"])
def test_a_protocol_without_keys_needs_an_allow_list(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, protocol: str
):
    monkeypatch.setenv(f"LUMILINE_{protocol.upper()}_PORT", "18944")
    monkeypatch.setenv(f"LUMILINE_{protocol.upper()}_HOST", "0.0.0.0")
    result = serve(tmp_path, monkeypatch)
    assert result.exit_code == 2
    [line] = result.output.splitlines()
    assert line.startswith("settings: ")
    assert f"{protocol}_allow" in line


def test_a_file_that_is_no_database(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "lumiline.sqlite3").write_bytes(b"no database, but long enough to be read" * 100)
    result = serve(tmp_path, monkeypatch)
    assert_one_line(result, 1, "lumiline.sqlite3 cannot be used", "file is not a database")


def test_a_database_of_a_later_version(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, database_url: str
):
    database = Database(database_url)
    migrate(database)
    with database.write() as session:
        session.execute(text("UPDATE alembic_version SET version_num = '9999'"))
    database.close()
    result = serve(tmp_path, monkeypatch, database_url)
    assert_one_line(result, 1, "is not of this version", "9999")


def test_a_data_directory_that_is_a_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "data").write_text("")
    result = serve(tmp_path / "data", monkeypatch)
    assert_one_line(result, 1, str(tmp_path / "data"), "Not a directory")


@pytest.mark.parametrize(
    "url",
    [
        f"nonsense {SECRET}",
        f"unknown://user:{SECRET}@host/database",
        f"mysql+mysqldb://user:{SECRET}@host/database",
        f"postgresql+psycopg://user:{SECRET}@host:port/database",
    ],
)
def test_a_url_that_means_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, url: str):
    result = serve(tmp_path, monkeypatch, url)
    assert_one_line(result, 2, "setting database_url", "postgresql+psycopg://USER:PASSWORD@HOST")


@pytest.mark.parametrize(
    "url",
    [
        f"postgresql+psycopg://user:{SECRET}@host/database",
        f"postgresql+psycopg://user@host/database?password={SECRET}",
    ],
)
def test_a_driver_that_repeats_the_password(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, url: str
):
    def refuse(*_: Any) -> None:
        raise OperationalError("SELECT 1", {}, Exception(f"bad\n\tpassword={SECRET} at host"))

    monkeypatch.setattr("service.cli.preflight.prepare", refuse)
    assert_one_line(serve(tmp_path, monkeypatch, url), 1, "bad; password=*** at host")


@pytest.mark.slow
def test_what_streams_keep_is_seldom_collected() -> None:
    """Each second they keep some ten thousand objects more, for ten seconds."""
    collected = []

    def see(phase: str, told: dict[str, int]) -> None:
        if phase == "start":
            collected.append(told["generation"])

    before = gc.get_threshold()
    try:
        freeze_gc()
        gc.callbacks.append(see)
        kept = [[number] for number in range(75_000)]
        assert set(collected) == {0}  # cycles are still looked for, among young objects
        assert len(collected) <= len(kept) / 5_000
    finally:
        gc.callbacks.remove(see)
        gc.set_threshold(*before)
        gc.unfreeze()


def test_young_garbage_is_collected_again_and_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where nothing new is made: that alone would bring a collection."""
    monkeypatch.setattr("service.cli.serve.COLLECT_S", 0.01)

    class Node:
        itself: "Node"

    async def until_collected() -> None:
        collect_young()
        for _ in range(3):
            node = Node()
            node.itself = node
            known = weakref.ref(node)
            del node
            while known() is not None:
                await asyncio.sleep(0.01)

    gc.disable()
    try:
        asyncio.run(asyncio.wait_for(until_collected(), 240.0))
    finally:
        gc.enable()
