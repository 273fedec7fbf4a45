"""PostgreSQL that hangs or takes too long is given up, and asked anew afterwards."""

from collections.abc import Iterator

import pytest
from sqlalchemy import make_url, text

from service.database import connection_options
from service.database.engine import Database
from service.database.server_lock import exclusive_lock, server_lock
from service.problems.errors import DatabaseInUse, NotReady

pytestmark = [
    pytest.mark.postgres,
    pytest.mark.parametrize("database_url", ["postgresql"], indirect=True),
]


@pytest.fixture
def served(database_url: str) -> Iterator[Database]:
    opened = Database(database_url, query_timeout=True)
    yield opened
    opened.close()


def sleep(database: Database, seconds: float) -> None:
    with database.read() as session:
        session.execute(text("SELECT pg_sleep(:seconds)"), {"seconds": seconds})


@pytest.mark.slow
def test_one_that_hangs(database_url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connection_options, "_STATEMENT_MS", 0)  # none, as of one that hangs
    served = Database(database_url, query_timeout=True)
    served.check()
    monkeypatch.setattr(connection_options, "ANSWER_S", 0.2)
    for _ in range(2):
        with pytest.raises(NotReady):
            sleep(served, 3.0)
    monkeypatch.undo()
    sleep(served, 0.0)
    served.close()


@pytest.mark.slow
def test_a_statement_that_takes_long(
    empty_database_url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connection_options, "_STATEMENT_MS", 200)
    served, patient = (Database(empty_database_url, query_timeout=it) for it in (True, False))
    with pytest.raises(NotReady):
        sleep(served, 60.0)
    sleep(patient, 0.4)  # a migration, a backup
    # What the URL says is kept: an empty database is a schema.
    with served.read() as session:
        assert session.scalar(text("SELECT current_schema()")) in empty_database_url
    served.close()
    patient.close()


def test_what_the_url_says_is_kept(database_url: str) -> None:
    own = {"connect_timeout": "9", "keepalives_idle": "99", "options": "-cstatement_timeout=7"}
    found = connection_options.timeouts(make_url(database_url).set(query=own), statements=True)
    assert not found.keys() & own.keys()
    assert {"tcp_user_timeout", "keepalives"} <= found.keys()


def test_what_is_used_is_said_again_by_new_connections(served: Database, database_url: str) -> None:
    other = Database(database_url)
    with server_lock(served):
        served.check()
        served.close()  # as after a restart of PostgreSQL: all connections are new
        with exclusive_lock(other):
            pass
        served.check()
        with pytest.raises(DatabaseInUse), exclusive_lock(other):
            pass
    other.close()
