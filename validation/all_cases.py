"""All cases by their names on the command line."""

from typing import Final

from validation.cases import CASES, Case
from validation.tables import TablesCase

_TABLES: Final[tuple[TablesCase, ...]] = ()

ALL_CASES: Final[dict[str, Case | TablesCase]] = {
    **CASES,
    **{case.name: case for case in _TABLES},
}
"""Tests of chapter 5, then tables and questions."""
