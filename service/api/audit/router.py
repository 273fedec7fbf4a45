"""REST resource /api/v1/audit: who changed what."""

import re
from dataclasses import dataclass
from operator import eq, ge, lt
from typing import Annotated, Any, Literal

from fastapi import Depends, Query
from pydantic import BeforeValidator, Field
from sqlalchemy import Select, select

from service.api.base_models import Moment, RequestMoment, ResponseModel, from_attributes
from service.api.inputs import DatabaseDep
from service.api.openapi import ResourceRouter
from service.api.paging import LATEST_FIRST, Page, PagingDep, page_of
from service.database.models import AuditRow

router = ResourceRouter("/api/v1/audit", "keys")

_RFC3339 = re.compile(r"\d{4}-\d\d-\d\d[Tt ]\d\d:\d\d:\d\d(\.\d+)?([Zz]|[+-]\d\d:\d\d)", re.ASCII)


def _written_out(text: object) -> object:
    """Refuse what pydantic would take for a moment, too: a number of seconds."""
    if isinstance(text, str) and _RFC3339.fullmatch(text) is None:
        raise ValueError("must be a moment with its time zone, such as 2026-01-31T12:00:00Z")
    return text


QueryMoment = Annotated[RequestMoment, BeforeValidator(_written_out)]

Outcome = Literal["done", "refused"]


class Actor(ResponseModel):
    """Key, token or local program that acted."""

    kind: Literal["key", "token", "local", "command", "service"] = Field(
        description="An API key, a token of the identity provider, a program on the server's own "
        "machine without a key, the command line, or the server itself."
    )
    id: str = Field(description="The key's id, the token's subject, or the user.")
    name: str


class AuditEntry(ResponseModel):
    """One change, or an attempt that was refused."""

    id: int
    created_at: Moment
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


def _text(max_length: int, description: str) -> Any:
    return Query(max_length=max_length, pattern=r"^[^\u0000]*$", description=description)


@dataclass(frozen=True)
class AuditFilter:
    """Filters of audit entries; an entry must agree with all of them."""

    actor_id: Annotated[str | None, _text(200, "Only of this key id, subject or user.")] = None
    operation: Annotated[str | None, _text(64, "Only this operation's.")] = None
    outcome: Annotated[Outcome | None, Query(description="Only these.")] = None
    object_kind: Annotated[str | None, _text(32, "Only objects of this kind: device, ...")] = None
    object_id: Annotated[str | None, _text(200, "Only of this object.")] = None
    since: Annotated[QueryMoment | None, Query(description="From this moment on.")] = None
    until: Annotated[QueryMoment | None, Query(description="Before this moment.")] = None

    def entries(self) -> Select[AuditRow]:
        """Return the entries."""
        conditions = (
            (AuditRow.actor_id, eq, self.actor_id),
            (AuditRow.operation, eq, self.operation),
            (AuditRow.outcome, eq, self.outcome),
            (AuditRow.object_kind, eq, self.object_kind),
            (AuditRow.object_id, eq, self.object_id),
            (AuditRow.at, ge, self.since),
            (AuditRow.at, lt, self.until),
        )
        given = [
            compare(column, value) for column, compare, value in conditions if value is not None
        ]
        return select(AuditRow).where(*given)


@router.operation("GET", "list-audit", "Who changed what")
def list_audit(
    database: DatabaseDep, chosen: Annotated[AuditFilter, Depends()], paging: PagingDep
) -> Page[AuditEntry]:
    """Changes, and attempts that were refused, newest first. Nothing is ever removed."""
    with database.read() as session:
        return page_of(session, chosen.entries(), paging, _document, LATEST_FIRST)


def _document(row: AuditRow) -> AuditEntry:
    actor = {name: getattr(row, f"actor_{name}") for name in Actor.model_fields}
    return from_attributes(AuditEntry, row, created_at=row.at, actor=actor)
