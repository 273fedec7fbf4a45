"""Scopes of keys by what their misuse can break.

Each former scope becomes the set of scopes that allow the same operations together: no key loses a
right, and none gains one. Back again a key gets a former scope only if it has all of its set, since
it would gain rights otherwise.
"""

from collections.abc import Callable
from typing import Final

import sqlalchemy as sa
from alembic import op

revision = "0013"
down_revision = "0012"
branch_labels = None
depends_on = None

_KEPT: Final = ("read:stream", "read:calibration")
REPLACED: Final[dict[str, tuple[str, ...]]] = {
    "write:calibration": (
        "operate:holds",
        "operate:checks",
        "write:tools",
        "write:registrations",
        "write:holds",
        "write:calibrations",
        "write:results",
        "activate:calibrations",
    ),
    "admin:hardware": (
        "operate:devices",
        "operate:recordings",
        "write:recordings",
        "admin:devices",
    ),
    "admin:keys": ("read:audit", "admin:keys"),
}
"""By former scope the scopes that replace it."""


def upgrade() -> None:
    _replace(_split)


def downgrade() -> None:
    _replace(_join)


def _split(scopes: list[str]) -> list[str]:
    return [new for old in scopes for new in REPLACED.get(old, (old,))]


def _join(scopes: list[str]) -> list[str]:
    whole = [old for old, new in REPLACED.items() if set(new) <= set(scopes)]
    return [*whole, *(scope for scope in scopes if scope in _KEPT)]


def _replace(replace: Callable[[list[str]], list[str]]) -> None:
    bind = op.get_bind()
    rows = sa.Table("api_keys", sa.MetaData(), autoload_with=bind)
    for key, scopes in bind.execute(sa.select(rows.c.id, rows.c.scopes)).all():
        if not isinstance(scopes, list):
            continue
        replaced = sorted(replace(scopes))
        if replaced != scopes:
            bind.execute(rows.update().where(rows.c.id == key).values(scopes=replaced))
