"""Ids that open runs are to store their results under: of all runs of all devices, one has each."""

from collections.abc import Iterator
from datetime import UTC, datetime
from threading import Event, Thread

import pytest
from alembic import command
from sqlalchemy import inspect, select

from service.application.initial_content import seed
from service.database.engine import Database
from service.database.migration import alembic_config, migrate
from service.database.models import DeviceRow, RunRow
from service.jobs import store
from service.jobs.store import Kind
from service.problems.errors import CalibrationExists, CorrectionTableExists


@pytest.fixture
def database(database_url: str) -> Iterator[Database]:
    """A database with two devices."""
    opened = Database(database_url)
    migrate(opened, fill=seed)
    now = datetime.now(UTC)
    with opened.write() as session:
        session.add(
            DeviceRow(
                id="other",
                title="Other",
                source={},
                sensors=[],
                autostart=False,
                created_at=now,
                updated_at=now,
            )
        )
    yield opened
    opened.close()


def add(database: Database, run: str, kind: Kind, device: str = "sim") -> None:
    with database.write() as session:
        store.add_run(session, kind, device, {"result_id": "made"}, 100, run)


def test_an_open_run_keeps_its_id_from_others_until_it_ends(database: Database):
    add(database, "first", "calibration")
    add(database, "map", "mapping")  # a table, not a calibration
    for kind, device in (("self-calibration", "sim"), ("update", "other")):
        with pytest.raises(CalibrationExists, match='run "first" is to make calibration "made"'):
            add(database, "second", kind, device)
    with pytest.raises(CorrectionTableExists, match='run "map" is to make correction table'):
        add(database, "second", "mapping", "other")
    with database.write() as session:
        store.cancel(session, "first")
        store.cancel(session, "map")
    add(database, "second", "calibration", "other")
    add(database, "third", "mapping", "other")


def test_of_two_at_the_same_moment_one_is_refused(database: Database):
    """The first has not committed when the second begins: no look beforehand could see it."""
    begun, refused = Event(), []

    def second() -> None:
        begun.set()
        try:
            add(database, "second", "calibration", "other")
        except CalibrationExists as error:
            refused.append(error.detail)

    thread = Thread(target=second)
    with database.write() as session:
        store.add_run(session, "calibration", "sim", {"result_id": "made"}, 100, "first")
        thread.start()
        begun.wait()
        thread.join(0.3)  # it waits for this transaction, in either database
        assert thread.is_alive()
    thread.join()
    assert len(refused) == 1
    with database.read() as session:
        assert session.scalars(select(RunRow.id)).all() == ["first"]


@pytest.mark.slow
def test_runs_of_before_keep_their_ids(database: Database):
    """The migration claims for runs that wait; of two that have one id, for the first."""
    with database.write() as session:
        for run, state in (("ended", "failed"), ("first", "queued"), ("twice", "queued")):
            row = store.add_run(session, "calibration", "sim", {}, 100, run)
            row.state, row.request = state, {"result_id": "made"}
        store.add_run(session, "mapping", "sim", {}, 100, "map").request = {"result_id": "made"}
    with database.engine.begin() as connection:
        config = alembic_config(connection)
        command.downgrade(config, "0002")
        columns = {column["name"] for column in inspect(connection).get_columns("runs")}
        assert "claim" not in columns
        command.upgrade(config, "head")
    with database.read() as session:
        claims = {row.id: row.claim for row in session.scalars(select(RunRow))}
    assert claims == {
        "ended": None, "first": "calibration/made", "twice": None, "map": "table/made",
    }  # fmt: skip
