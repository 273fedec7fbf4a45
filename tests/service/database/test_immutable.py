"""The database refuses to change what is immutable, whoever asks."""

from datetime import UTC, datetime

import pytest
from sqlalchemy import text, update
from sqlalchemy.exc import DBAPIError

from service.backup.consistency import find_inconsistencies
from service.database.engine import Database
from service.database.models import (
    ActivationRow,
    AuditRow,
    Base,
    CalibrationRow,
    CorrectionTableRow,
    DriftCheckRow,
    QualityCheckRow,
    RadiometricActivationRow,
    RadiometricCalibrationRow,
    RegistrationRow,
    ToolCalibrationRow,
)
from tests.service.database.sample_rows import content, fill

UNCHANGED = {
    CalibrationRow: {"retired_at"},
    CorrectionTableRow: set(),
    ActivationRow: set(),
    DriftCheckRow: set(),
    QualityCheckRow: set(),
    RegistrationRow: set(),
    ToolCalibrationRow: set(),
    RadiometricCalibrationRow: set(),
    RadiometricActivationRow: set(),
}


@pytest.fixture
def filled(database: Database) -> Database:
    with database.engine.begin() as connection:
        fill(connection)
    return database


def test_every_column_of_it(filled: Database) -> None:
    with filled.engine.connect() as connection:
        before = content(connection)
    for row, others in UNCHANGED.items():
        for column in row.__table__.columns:
            if column.name in others:
                continue
            value = None if column.nullable else column
            query = update(row).values({column.name: value})
            with pytest.raises(DBAPIError, match="are never changed"), filled.engine.begin() as one:
                one.execute(query)
    with filled.engine.connect() as connection:
        assert content(connection) == before


def test_a_calibration_is_retired_once(filled: Database) -> None:
    def retire(value: datetime | None) -> None:
        with filled.engine.begin() as connection:
            query = update(CalibrationRow).where(CalibrationRow.id == "sim-nominal")
            connection.execute(query.values(retired_at=value))

    now = datetime.now(UTC)
    retire(now)
    for other in (None, datetime(2020, 1, 1, tzinfo=UTC)):
        with pytest.raises(DBAPIError, match="retired once"):
            retire(other)
    retire(now)


@pytest.mark.parametrize("database_url", ["postgresql"], indirect=True)
@pytest.mark.postgres
def test_the_audit_log_is_not_truncated(filled: Database) -> None:
    with pytest.raises(DBAPIError, match="never deleted"), filled.engine.begin() as connection:
        connection.execute(text("TRUNCATE audit_log"))


@pytest.mark.parametrize("database_url", ["sqlite"], indirect=True)
@pytest.mark.parametrize("key", ["id", "rowid"])
@pytest.mark.parametrize("row", [*UNCHANGED, AuditRow])
def test_nothing_is_replaced(filled: Database, row: type[Base], key: str) -> None:
    table = Base.metadata.tables[row.__tablename__]
    names = [column.name for column in table.columns]
    # By the row's own number its id may be another one.
    given = names if key == "id" else ["rowid", "'another'", *names[1:]]
    into = names if key == "id" else ["rowid", *names]
    if key == "rowid" and row in (ActivationRow, AuditRow, RadiometricActivationRow):
        pytest.skip("its id is its number")
    with filled.engine.connect() as connection:
        before = content(connection)
    statement = (
        f"INSERT OR REPLACE INTO {table.name} ({', '.join(into)}) "
        f"SELECT {', '.join(given)} FROM {table.name} LIMIT 1"
    )
    with (
        pytest.raises(DBAPIError, match="are never replaced"),
        filled.engine.begin() as connection,
    ):
        connection.exec_driver_sql(statement)
    with filled.engine.connect() as connection:
        assert content(connection) == before


def complaints_after(database: Database, *statements: str) -> list[str]:
    with database.engine.connect() as connection:
        assert find_inconsistencies(connection) == []
    with database.engine.begin() as connection:
        for statement in statements:
            connection.exec_driver_sql(statement)
    with database.engine.connect() as connection:
        return [line.split(":")[0] for line in find_inconsistencies(connection)]


def test_a_trigger_that_was_taken_away_is_told(database: Database) -> None:
    postgres = database.engine.dialect.name == "postgresql"
    names = ["audit_log_unchanged", "calibrations_unchanged", "quality_checks_unchanged"]
    names += ["audit_log_truncated"] if postgres else ["audit_log_not_replaced"]
    statements = [
        f"DROP TRIGGER {name}" + (f" ON {name.rsplit('_', 1)[0]}" if postgres else "")
        for name in names
    ]
    assert complaints_after(database, *statements) == [
        f"the trigger {name} is missing" for name in sorted(names)
    ]


@pytest.mark.parametrize("database_url", ["sqlite"], indirect=True)
def test_a_trigger_that_was_altered_is_told(database: Database) -> None:
    found = complaints_after(
        database,
        "DROP TRIGGER audit_log_kept",
        "CREATE TRIGGER audit_log_kept BEFORE DELETE ON audit_log BEGIN SELECT 1; END",
        "DROP TRIGGER activations_unchanged",
        "CREATE TRIGGER activations_unchanged BEFORE UPDATE ON devices BEGIN "
        "SELECT RAISE(ABORT, 'rows of activations are never changed'); END",
    )
    assert found == [
        "the trigger activations_unchanged is not what it was",
        "the trigger audit_log_kept is not what it was",
    ]


@pytest.mark.parametrize("database_url", ["postgresql"], indirect=True)
@pytest.mark.postgres
def test_triggers_that_postgresql_does_not_ask_are_told(database: Database) -> None:
    found = complaints_after(
        database,
        "ALTER TABLE audit_log DISABLE TRIGGER audit_log_kept",
        "ALTER TABLE calibrations ENABLE REPLICA TRIGGER calibrations_retired",
        "DROP TRIGGER activations_unchanged ON activations",
        "CREATE TRIGGER activations_unchanged BEFORE UPDATE ON devices FOR EACH ROW "
        "EXECUTE FUNCTION lumiline_refuse('changed')",
        "CREATE OR REPLACE FUNCTION lumiline_refuse() RETURNS trigger LANGUAGE plpgsql AS "
        "$$ BEGIN RETURN NEW; END $$",
    )
    assert found == [
        "the function lumiline_refuse is not what it was",
        "the trigger activations_unchanged is not what it was",
        "the trigger audit_log_kept is switched off",
        "the trigger calibrations_retired is switched off",
    ]
