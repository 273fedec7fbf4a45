"""The audit log in the database: read by pages; written by `changes`, never changed."""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime

from sqlalchemy import ColumnElement, func, select
from sqlalchemy.orm import Session

from service.api.audit.schema import Actor, AuditEntry, Outcome
from service.database.models import AuditRow


@dataclass(frozen=True)
class AuditFilter:
    """Which entries: all that agree with what is given."""

    actor: str | None = None
    operation: str | None = None
    outcome: Outcome | None = None
    object_kind: str | None = None
    object_id: str | None = None
    since: datetime | None = None
    until: datetime | None = None

    def conditions(self) -> list[ColumnElement[bool]]:
        """Return it as SQL."""
        equal = {
            AuditRow.actor_id: self.actor,
            AuditRow.operation: self.operation,
            AuditRow.outcome: self.outcome,
            AuditRow.object_kind: self.object_kind,
            AuditRow.object_id: self.object_id,
        }
        found: list[ColumnElement[bool]] = [
            column == value for column, value in equal.items() if value is not None
        ]
        if self.since is not None:
            found.append(AuditRow.at >= self.since)
        if self.until is not None:
            found.append(AuditRow.at < self.until)
        return found


def list_entries(
    session: Session, chosen: AuditFilter, limit: int, offset: int
) -> tuple[Sequence[AuditRow], int]:
    """Return a page of entries, newest first, and how many the filter matches."""
    conditions = chosen.conditions()
    total = session.scalar(select(func.count()).select_from(AuditRow).where(*conditions))
    rows = session.scalars(
        select(AuditRow).where(*conditions).order_by(AuditRow.id.desc()).limit(limit).offset(offset)
    ).all()
    return rows, total or 0


def document(row: AuditRow) -> AuditEntry:
    """Return an entry as clients see it."""
    return AuditEntry(
        id=row.id,
        at=row.at,
        actor=Actor.model_validate(
            {"kind": row.actor_kind, "id": row.actor_id, "name": row.actor_name}
        ),
        operation=row.operation,
        outcome="done" if row.outcome == "done" else "refused",
        object_kind=row.object_kind,
        object_id=row.object_id,
        before=row.before,
        after=row.after,
        detail=row.detail,
        request_id=row.request_id,
        address=row.address,
    )
