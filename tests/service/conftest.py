"""Fixtures: the real application over a new database of each kind, with a recorded live side."""

import os
import secrets
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from sqlalchemy import create_engine, text
from sqlalchemy.engine import make_url
from sqlalchemy.exc import DBAPIError, OperationalError

from service.application.app import create_app
from service.application.bootstrap import prepare
from service.application.initial_content import seed
from service.database.engine import Database
from service.database.migration import migrate
from service.settings import Settings
from tests.running_server import serving
from tests.service.fake_pipeline import FakePipeline, TestClient

POSTGRES = os.environ.get(
    "LUMILINE_TEST_POSTGRES", "postgresql+psycopg://postgres@127.0.0.1:5432/test"
)


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Base URL of a running service."""
    with serving(tmp_path_factory.mktemp("server")) as url:
        yield url


@pytest.fixture(scope="session")
def new_sqlite(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The file of a database as a first start leaves it: to copy, as that takes a while."""
    settings = Settings(data_dir=tmp_path_factory.mktemp("new"))
    database = Database(settings.effective_database_url)
    try:
        prepare(settings, database)
    finally:
        database.close()
    return settings.data_dir / "lumiline.sqlite3"


@pytest.fixture(scope="session")
def new_postgres(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str | None]:
    """The same of PostgreSQL: a database's name; None where databases may not be made."""
    name = f"lumiline_{secrets.token_hex(6)}"
    server = make_url(POSTGRES).update_query_dict({"connect_timeout": "3"})
    engine = create_engine(server, isolation_level="AUTOCOMMIT")
    try:
        with engine.connect() as connection:
            connection.execute(text(f"CREATE DATABASE {name} TEMPLATE template0"))
    except DBAPIError:  # or no server is there: who needs a schema is told so
        engine.dispose()
        yield None
        return
    try:
        url = make_url(POSTGRES).set(database=name).render_as_string(hide_password=False)
        settings = Settings(data_dir=tmp_path_factory.mktemp("new"), database_url=url)
        database = Database(url)
        try:
            prepare(settings, database)
        finally:
            database.close()
        yield name
    finally:
        with engine.connect() as connection:
            connection.execute(text(f"DROP DATABASE {name} WITH (FORCE)"))
        engine.dispose()


@pytest.fixture(params=["sqlite", pytest.param("postgresql", marks=pytest.mark.postgres)])
def database_url(request: pytest.FixtureRequest, tmp_path: Path, new_sqlite: Path) -> Iterator[str]:
    """The URL of a new database, which is removed afterwards."""
    if request.param == "sqlite":
        shutil.copy(new_sqlite, tmp_path)
        yield f"sqlite:///{tmp_path / new_sqlite.name}"
        return
    template = request.getfixturevalue("new_postgres")
    if template is None or "empty_database_url" in request.fixturenames:
        yield from postgres_schema()
    else:
        yield from postgres_copy(template)


@pytest.fixture
def empty_database_url(database_url: str) -> str:
    """The URL of a database before its first start."""
    if database_url.startswith("sqlite"):
        Path(database_url.removeprefix("sqlite:///")).unlink()
    return database_url


def postgres_copy(template: str) -> Iterator[str]:
    """Yield the URL of a copy of a database in the PostgreSQL server for tests."""
    name = f"lumiline_{secrets.token_hex(6)}"
    engine = create_engine(make_url(POSTGRES), isolation_level="AUTOCOMMIT")
    try:
        with engine.connect() as connection:
            connection.execute(text(f"CREATE DATABASE {name} TEMPLATE {template}"))
        yield make_url(POSTGRES).set(database=name).render_as_string(hide_password=False)
        with engine.connect() as connection:
            connection.execute(text(f"DROP DATABASE {name} WITH (FORCE)"))
    finally:
        engine.dispose()


def postgres_schema() -> Iterator[str]:
    """Yield the URL of a new schema in the PostgreSQL server for tests."""
    engine = create_engine(make_url(POSTGRES).update_query_dict({"connect_timeout": "3"}))
    name = f"lumiline_{secrets.token_hex(6)}"
    try:
        try:
            with engine.begin() as connection:
                connection.execute(text(f"CREATE SCHEMA {name}"))
        except OperationalError as error:
            reason = f"no PostgreSQL at {make_url(POSTGRES)!r}: {error.orig}"
            if os.environ.get("LUMILINE_TEST_REQUIRE_POSTGRES") == "1":
                pytest.fail(reason)
            pytest.skip(reason)
        url = make_url(POSTGRES).update_query_dict({"options": f"-csearch_path={name}"})
        yield url.render_as_string(hide_password=False)
        with engine.begin() as connection:
            connection.execute(text(f"DROP SCHEMA {name} CASCADE"))
    finally:
        engine.dispose()


@pytest.fixture
def database(database_url: str) -> Iterator[Database]:
    """A new database with its first content."""
    opened = Database(database_url)
    migrate(opened, fill=seed)
    yield opened
    opened.close()


@pytest.fixture
def settings(database_url: str, tmp_path: Path) -> Settings:
    """Settings with a data directory of their own."""
    return Settings(data_dir=tmp_path / "data", database_url=database_url)


@pytest.fixture
def live() -> FakePipeline:
    """The live side's recorder."""
    return FakePipeline()


@pytest.fixture
def client(settings: Settings, live: FakePipeline) -> Iterator[TestClient]:
    """A client of the running application; exceptions become responses, as for real clients."""
    with TestClient(create_app(settings, live), raise_server_exceptions=False) as running:
        yield running


@pytest.fixture
def sqlite_settings(tmp_path: Path, new_sqlite: Path) -> Settings:
    """Settings over SQLite, for tests in which the database plays no part."""
    folder = tmp_path / "data"
    folder.mkdir(exist_ok=True)
    shutil.copy(new_sqlite, folder)
    return Settings(data_dir=folder)


@pytest.fixture
def sqlite_client(sqlite_settings: Settings, live: FakePipeline) -> Iterator[TestClient]:
    """A client of the application over SQLite."""
    with TestClient(create_app(sqlite_settings, live), raise_server_exceptions=False) as running:
        yield running
