"""The database: models equal migrations, down and up again, transactions, constraints."""

from collections.abc import Iterator
from datetime import UTC, datetime, timedelta, timezone

import pytest
from alembic import command
from alembic.autogenerate import compare_metadata
from alembic.runtime.migration import MigrationContext
from sqlalchemy import inspect, select, text
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from service.api.devices.store import delete_device
from service.application.initial_content import seed
from service.database.engine import Database
from service.database.migration import alembic_config, migrate
from service.database.models import ActivationRow, ActiveCalibrationRow, Base, DeviceRow


@pytest.fixture
def database(empty_database_url: str) -> Iterator[Database]:
    opened = Database(empty_database_url)
    yield opened
    opened.close()


def test_migrations_make_what_the_models_say(database: Database):
    assert migrate(database) is True
    with database.engine.connect() as connection:
        context = MigrationContext.configure(connection, opts={"compare_type": True})
        assert compare_metadata(context, Base.metadata) == []
        found = inspect(connection)
        for table in Base.metadata.sorted_tables:
            keys = {tuple(key["constrained_columns"]) for key in found.get_foreign_keys(table.name)}
            assert keys == {tuple(key.column_keys) for key in table.foreign_key_constraints}


@pytest.mark.slow
def test_down_and_up_again(database: Database):
    migrate(database)
    with database.engine.begin() as connection:
        command.downgrade(alembic_config(connection), "base")
        assert set(inspect(connection).get_table_names()) <= {"alembic_version"}
    assert migrate(database, fill=seed) is True
    assert migrate(database) is False
    with database.read() as session:
        assert session.scalars(select(DeviceRow.id)).all() == ["sim"]


def test_a_failed_write_leaves_nothing(database: Database):
    migrate(database, fill=seed)

    def fail_half_way() -> None:
        with database.write() as session:
            session.execute(text("DELETE FROM activations"))
            raise RuntimeError("stop")

    with pytest.raises(RuntimeError, match="stop"):
        fail_half_way()
    with database.read() as session:
        assert len(session.scalars(select(ActivationRow)).all()) == 1


def test_the_pointer_cannot_point_to_a_calibration_of_another_device(database: Database):
    migrate(database, fill=seed)
    now = datetime.now(UTC)
    with database.write() as session:
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
    with pytest.raises(IntegrityError), database.write() as session:
        session.add(ActiveCalibrationRow(device_id="other", calibration_id="sim-nominal"))


def test_times_come_back_as_utc(database: Database):
    migrate(database, fill=seed)
    there = datetime(2024, 7, 1, 12, 0, tzinfo=timezone(timedelta(hours=5)))
    with database.write() as session:
        session.get_one(DeviceRow, "sim").updated_at = there
    with database.read() as session:
        read = session.get_one(DeviceRow, "sim").updated_at
    assert read == there
    assert read.utcoffset() == timedelta(0)


def test_a_time_without_zone_is_refused(database: Database):
    migrate(database, fill=seed)
    with pytest.raises(Exception, match="no time zone"), database.write() as session:
        session.get_one(DeviceRow, "sim").updated_at = datetime(2024, 7, 1)  # noqa: DTZ001


def test_sqlite_is_set_up_for_one_writer_and_many_readers(tmp_path):
    database = Database(f"sqlite:///{tmp_path / 'one.sqlite3'}")
    try:
        with database.engine.connect() as connection:
            values = {
                name: connection.exec_driver_sql(f"PRAGMA {name}").scalar()
                for name in ("journal_mode", "foreign_keys", "busy_timeout", "synchronous")
            }
    finally:
        database.close()
    assert values == {
        "journal_mode": "wal",
        "foreign_keys": 1,
        "busy_timeout": 5000,
        "synchronous": 2,
    }


def devices(database: Database) -> list[str]:
    with database.read() as session:
        return list(session.scalars(select(DeviceRow.id)))


@pytest.mark.slow
def test_a_first_start_that_was_cut_short_is_made_again(database: Database):
    def cut_short(session: Session) -> None:
        seed(session)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        migrate(database, fill=cut_short)
    with database.engine.connect() as connection:
        assert inspect(connection).get_table_names() == []
    assert migrate(database, fill=seed) is True
    assert devices(database) == ["sim"]


def test_the_first_content_comes_once(database: Database):
    migrate(database, fill=seed)
    with database.write() as session:
        delete_device(session, "sim", cascade=True)
    assert migrate(database, fill=seed) is False
    assert devices(database) == []
