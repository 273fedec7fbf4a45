"""REST resource /api/v1/audit: who changed what."""

import re
from typing import Annotated

from fastapi import Query
from pydantic import BeforeValidator

from service.api.audit import store
from service.api.audit.store import AuditEntry, AuditFilter, Outcome
from service.api.base_models import Page, RequestMoment
from service.api.dependencies import DatabaseDep
from service.api.openapi import ResourceRouter
from service.api.request_parameters import Limit, Offset

router = ResourceRouter("/api/v1/audit", "keys")

_RFC3339 = re.compile(r"\d{4}-\d\d-\d\d[Tt ]\d\d:\d\d:\d\d(\.\d+)?([Zz]|[+-]\d\d:\d\d)", re.ASCII)


def _written_out(text: object) -> object:
    """Refuse what pydantic would take for a moment, too: a number of seconds."""
    if isinstance(text, str) and _RFC3339.fullmatch(text) is None:
        raise ValueError("must be a moment with its time zone, such as 2026-01-31T12:00:00Z")
    return text


QueryMoment = Annotated[RequestMoment, BeforeValidator(_written_out)]

_WORD = r"^[^\u0000]*$"


@router.operation("GET", "list-audit", "Who changed what")
def list_audit(
    database: DatabaseDep,
    actor: Annotated[
        str | None,
        Query(max_length=200, pattern=_WORD, description="Only of this key id, subject or user."),
    ] = None,
    operation: Annotated[
        str | None, Query(max_length=64, pattern=_WORD, description="Only this operation's.")
    ] = None,
    outcome: Annotated[Outcome | None, Query(description="Only these.")] = None,
    kind: Annotated[
        str | None,
        Query(max_length=32, pattern=_WORD, description="Only objects of this kind: device, ..."),
    ] = None,
    object_id: Annotated[
        str | None,
        Query(alias="object", max_length=200, pattern=_WORD, description="Only of this object."),
    ] = None,
    since: Annotated[QueryMoment | None, Query(description="From this moment on.")] = None,
    until: Annotated[QueryMoment | None, Query(description="Before this moment.")] = None,
    limit: Limit = 50,
    offset: Offset = 0,
) -> Page[AuditEntry]:
    """Changes, and attempts that were refused, newest first. Nothing is ever removed."""
    chosen = AuditFilter(actor, operation, outcome, kind, object_id, since, until)
    with database.read() as session:
        rows, total = store.list_entries(session, chosen, limit, offset)
        items = [store.document(row) for row in rows]
    return Page(items=items, total=total, limit=limit, offset=offset)
