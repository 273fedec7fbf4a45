"""Referrers of a row: what is named by others is kept, and the refusal says by which."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from sqlalchemy import ColumnElement, func, select
from sqlalchemy.orm import Session

from compute.errors import LumilineError
from service.database.models import Base

Conditions = Mapping[str, tuple[type[Base], ColumnElement[bool]]]
"""By kind, such as ``tools``: the table, and which of its rows refer."""

_NAMED: Final = 5
"""Ids of each kind that a refusal names; beyond them the number says enough."""


@dataclass(frozen=True)
class Referrers:
    """Rows of one kind that refer to another row.

    Args:
        kind: plural, such as ``tools``.
        count: number of rows.
        ids: of the first few.
    """

    kind: str
    count: int
    ids: tuple[str, ...]

    def __str__(self) -> str:
        """Return the number, the kind and the ids."""
        kind = self.kind if self.count != 1 else self.kind.removesuffix("s")
        more = ", ..." if self.count > len(self.ids) else ""
        ids = ", ".join(f'"{one}"' for one in self.ids)
        return f"{self.count} {kind} ({ids}{more})"


def find_referrers(session: Session, conditions: Conditions) -> list[Referrers]:
    """Return what refers to a row, by kind; nothing of kinds that do not."""
    found = []
    for kind, (table, condition) in conditions.items():
        count = session.scalar(select(func.count()).select_from(table).where(condition)) or 0
        if count:
            key: Any = table.__mapper__.primary_key[0]
            ids = session.scalars(select(key).where(condition).order_by(key).limit(_NAMED))
            found.append(Referrers(kind, count, tuple(str(one) for one in ids)))
    return found


def refuse_if_referred(
    session: Session, error: type[LumilineError], row: Any, advice: str, conditions: Conditions
) -> None:
    """Raise an error where others refer to a row.

    Args:
        session: the session.
        error: its class.
        row: the row.
        advice: what would be right.
        conditions: rows that refer to it.
    """
    found = find_referrers(session, conditions)
    if found:
        what = type(row).__tablename__.removesuffix("s").replace("_", " ")
        raise error(
            f'{what} "{row.id}" is referred to by {", ".join(map(str, found))}; {advice}',
            id=row.id,
            referrers={one.kind: list(one.ids) for one in found},
        )
