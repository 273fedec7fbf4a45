"""Requests run over SQLite in ``make test``, over PostgreSQL in ``make test-slow``.

What PostgreSQL does otherwise is tested in both, in tests/service/database and where a database's
part is the test's subject (backups, claims of runs, concurrent requests, outages).
"""

from pathlib import Path

import pytest


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the variants over PostgreSQL of this folder's tests as slow."""
    for item in items:
        if item.get_closest_marker("postgres") and item.path.is_relative_to(Path(__file__).parent):
            item.add_marker(pytest.mark.slow)
