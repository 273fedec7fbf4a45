"""Members of stored documents that refer to a resource are called ``*_id``, durations ``*_s``.

Of each document only its own members are renamed, not those of what it contains. What is hashed
(calibrations, radiometric calibrations, files of correction tables) stays as it is, and so does the
audit log.
"""

from collections.abc import Callable
from typing import Any, Final

import sqlalchemy as sa
from alembic import op

from migrations.versions.v0010_standard_terms import Names, _unguarded

revision = "0015"
down_revision = "0014"
branch_labels = None
depends_on = None

_MADE_WITH: Final[Names] = {"calibration": "calibration_id", "table": "table_id"}
_DOCUMENTS: Final[dict[tuple[str, str], Names]] = {
    ("devices", "source"): {"profile": "profile_id", "recording": "recording_id"},
    ("runs", "request"): {
        **_MADE_WITH,
        "capture": "capture_id",
        "drift_check": "drift_check_id",
        "recording": "recording_id",
        "start": "start_calibration_id",
    },
    ("drift_checks", "given"): {
        "capture": "capture_id",
        "earlier_capture": "earlier_capture_id",
    },
    ("quality_checks", "asked"): {"seconds": "duration_s"},
    ("tools", "tip"): {"calibration": "tool_calibration_id"},
    ("tools", "origin"): _MADE_WITH,
    ("tool_calibrations", "asked"): {"seconds": "duration_s"},
    ("tool_calibrations", "result"): _MADE_WITH,
    ("registrations", "asked"): {
        "device": "device_id",
        "reference": "reference_id",
        "parent": "parent_id",
        "seconds": "duration_s",
    },
    ("registrations", "result"): {**_MADE_WITH, "parent": "parent_id"},
    ("holds", "watch"): {"tool": "tool_id"},
    ("holds", "reference"): _MADE_WITH,
}
"""Members that are renamed, by table and column."""


def upgrade() -> None:
    _rename(lambda names: names)


def downgrade() -> None:
    _rename(lambda names: {new: old for old, new in names.items()})


def _rename(direction: Callable[[Names], Names]) -> None:
    bind = op.get_bind()
    tables = sa.MetaData()
    with _unguarded(bind):
        for (table, column), names in _DOCUMENTS.items():
            rows = sa.Table(table, tables, autoload_with=bind)
            found = bind.execute(sa.select(rows.c.id, rows.c[column])).all()
            for key, document in found:
                renamed = _renamed(document, direction(names))
                if renamed != document:
                    bind.execute(rows.update().where(rows.c.id == key).values({column: renamed}))


def _renamed(document: Any, names: Names) -> Any:
    if not isinstance(document, dict):
        return document
    return {names.get(name, name): value for name, value in document.items()}
