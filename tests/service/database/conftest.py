"""Databases of each kind, migrated and filled."""

from collections.abc import Iterator

import pytest

from service.application.initial_content import seed
from service.database.engine import Database
from service.database.migration import migrate


@pytest.fixture
def database(database_url: str) -> Iterator[Database]:
    """A new database with its first content."""
    opened = Database(database_url)
    migrate(opened, fill=seed)
    yield opened
    opened.close()
