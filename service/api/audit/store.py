"""Entries of the audit log: their schema, and pages of them from the database."""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any, Literal

from pydantic import Field
from sqlalchemy import ColumnElement, func, select
from sqlalchemy.orm import Session

from service.api.base_models import Moment, ResponseModel
from service.database.models import AuditRow

Outcome = Literal["done", "refused"]


class Actor(ResponseModel):
    """Who acted."""

    kind: Literal["key", "token", "local", "command", "service"] = Field(
        description="An API key, a token of the identity provider, a program on the server's own "
        "machine without a key, the command line, or the server itself."
    )
    id: str = Field(description="The key's id, the token's subject, or the user.")
    name: str


class AuditEntry(ResponseModel):
    """One change, or an attempt that was refused."""

    id: int
    at: Moment
    actor: Actor
    operation: str = Field(description="The operation's id in the OpenAPI document, or a command.")
    outcome: Outcome
    object_kind: str = Field(description="What was changed: device, calibration, key, ...")
    object_id: str | None
    before: dict[str, Any] | None = Field(description="Values that are no more, in short.")
    after: dict[str, Any] | None = Field(description="Values from then on, in short.")
    detail: str | None = Field(description="Why it was refused.")
    request_id: str | None = Field(description="Also in the answer's header X-Request-ID.")
    address: str | None


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
