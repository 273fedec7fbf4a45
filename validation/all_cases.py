"""All cases by their names on the command line."""

from typing import Final

from validation.cases import CASES, Case
from validation.skew_effect import CASE as SKEW_EFFECT
from validation.table_5_5 import CASE as TABLE_5_5
from validation.tables import TablesCase

_TABLES: Final[tuple[TablesCase, ...]] = (TABLE_5_5, SKEW_EFFECT)

ALL_CASES: Final[dict[str, Case | TablesCase]] = {
    **CASES,
    **{case.name: case for case in _TABLES},
}
"""Tests of chapter 5, then tables and questions."""
