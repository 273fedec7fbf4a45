"""Revisions down, and up again, with data in every table: what survives is what it was."""

import pytest
from alembic import command
from alembic.script import ScriptDirectory
from sqlalchemy import inspect

from service.database.engine import Database
from service.database.migration import alembic_config, migrate
from service.database.models import Base
from tests.service.database.sample_rows import common, fill, reflected


@pytest.mark.slow
def test_each_revision_down_and_up_again(database: Database) -> None:
    with database.engine.begin() as connection:
        fill(connection)
        whole = reflected(connection)
    assert all(whole.values()), [name for name, rows in whole.items() if not rows]
    assert whole.keys() == Base.metadata.tables.keys()
    revisions = [
        script.revision
        for script in ScriptDirectory.from_config(alembic_config(connection)).walk_revisions()
    ]
    before = whole
    for revision in revisions[1:]:  # newest first
        with database.engine.begin() as connection:
            command.downgrade(alembic_config(connection), revision)
        with database.engine.connect() as connection:
            after = reflected(connection)
        here, there = common(after, before)
        assert here == there, revision
        assert after.keys() <= before.keys()
        before = after
    oldest = before
    assert set(oldest) >= {"devices", "calibrations", "activations", "reconstructions"}
    for revision in reversed(revisions[:-1]):
        with database.engine.begin() as connection:
            command.upgrade(alembic_config(connection), revision)
    with database.engine.connect() as connection:
        again = reflected(connection)
    here, there = common(again, oldest)
    assert here == there
    assert again.keys() == whole.keys()
    # What came back has the columns of before, and keeps new data.
    with database.engine.begin() as connection:
        fill(connection)
        for name, rows in reflected(connection).items():
            assert rows, name
            assert rows[0].keys() == whole[name][0].keys()


@pytest.mark.slow
def test_to_nothing_and_up_again_at_once(database: Database) -> None:
    with database.engine.begin() as connection:
        fill(connection)
    with database.engine.begin() as connection:
        command.downgrade(alembic_config(connection), "base")
    with database.engine.connect() as connection:
        assert set(inspect(connection).get_table_names()) <= {"alembic_version"}
    assert migrate(database) is True
