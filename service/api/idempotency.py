"""Idempotency-Key: the same request again is answered as before, and makes nothing a second time.

As the IETF draft "The Idempotency-Key HTTP Header Field" has it, by credential. The key is claimed
in a transaction before the request is carried out, so that of two at once, also to two servers, one
is carried out; only what succeeded is kept, since what was refused has stored nothing.
"""

import hashlib
import re
import zlib
from collections.abc import Callable, Coroutine
from datetime import UTC, datetime, timedelta
from typing import Any, Final

from sqlalchemy import delete, update
from sqlalchemy.exc import IntegrityError
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import Response
from starlette.types import Message, Receive

from service.database.engine import Database
from service.database.gateway import Gateway
from service.database.models import IdempotencyKeyRow
from service.principal import current_act
from service.problems.errors import (
    IdempotencyKeyReused,
    InvalidIdempotencyKey,
    RequestInProgress,
)
from service.problems.handlers import error_response

NAME: Final = "Idempotency-Key"
LIFETIME: Final = timedelta(hours=24)
ABANDONED_AFTER: Final = timedelta(minutes=15)
"""No request is carried out for longer: one that is older ended with its server, while others on
the same database went on."""
ORPHANED_AFTER: Final = timedelta(minutes=1)
"""The same where its server is known to live no more: one that was only held up, as with its
machine, may still carry it out."""
PROBLEMS: Final = ("idempotency-key-reused", "invalid-idempotency-key", "request-in-progress")
PARAMETER: Final[dict[str, Any]] = {
    "name": NAME,
    "in": "header",
    "required": False,
    "description": "A text of your choice, such as a UUID, for this request alone. Where its "
    "answer was lost, send it again with the same key: within 24 hours it gets the same answer, "
    "and makes nothing a second time.",
    "schema": {"type": "string", "minLength": 1, "maxLength": 255, "pattern": "^[!-~]+$"},
}

_KEY: Final = re.compile(r"[!-~]{1,255}")
_KEPT_HEADERS: Final = ("content-type", "location")
_RETRY_AFTER_S: Final = 1

Handler = Callable[[Request], Coroutine[Any, Any, Response]]


def takes_key(openapi_extra: dict[str, Any] | None) -> bool:
    """Whether an operation takes the header."""
    return PARAMETER in (openapi_extra or {}).get("parameters", ())


def once(handle: Handler) -> Handler:
    """Return a handler that carries a request with a key out once."""

    async def answer(request: Request) -> Response:
        key = request.headers.get(NAME)
        act = current_act.get()
        if key is None or act is None:
            return await handle(request)
        if _KEY.fullmatch(key) is None:
            raise InvalidIdempotencyKey(
                f"the header {NAME} has {len(key)} characters; send 1 to 255 visible ASCII "
                "characters without spaces, such as a UUID",
                characters=len(key),
            )
        database: Database = request.app.state.database
        gateway: Gateway = request.app.state.gateway
        claim = (f"{act.principal.kind}:{act.principal.id}", key)
        body = await request.body()
        fingerprint = _fingerprint(request, body)
        try:
            stored = await run_in_threadpool(_claim, database, gateway, claim, fingerprint)
        except RequestInProgress as error:
            headers = {"Retry-After": str(_RETRY_AFTER_S)}
            return error_response(error, request.url.path, headers)
        if stored is not None:
            act.recorded = True  # by the request that was carried out
            return stored
        kept = False
        try:
            response = await handle(Request(request.scope, _received(body, request.receive)))
            if response.status_code < 300:
                await run_in_threadpool(_keep, database, claim, response)
                kept = True
            return response
        finally:
            if not kept:
                await run_in_threadpool(_release, database, claim)

    return answer


def _received(body: bytes, receive: Receive) -> Receive:
    """Return what gives a body that was received already, and then what comes."""
    waiting: list[Message] = [{"type": "http.request", "body": body, "more_body": False}]

    async def received() -> Message:
        return waiting.pop() if waiting else await receive()

    return received


def forget_unfinished(database: Database, before: datetime) -> None:
    """Forget requests that ended with their server.

    Args:
        database: of the servers.
        before: when no server had the database: whatever was begun earlier has ended.
    """
    begun = IdempotencyKeyRow.created_at < before
    with database.write() as session:
        session.execute(delete(IdempotencyKeyRow).where(IdempotencyKeyRow.status.is_(None), begun))


def _fingerprint(request: Request, body: bytes) -> str:
    parts = (request.method, request.url.path, request.url.query)
    head = "\n".join((*parts, request.headers.get("content-type", "")))
    return hashlib.sha256(head.encode() + b"\n" + body).hexdigest()


def _claim(
    database: Database, gateway: Gateway, claim: tuple[str, str], fingerprint: str
) -> Response | None:
    """Claim a key; return the answer that was given, None where there was none.

    Raises:
        IdempotencyKeyReused: the key is another request's.
        RequestInProgress: the same request is being carried out.
    """
    now = datetime.now(UTC)
    try:
        with database.write() as session:
            created = IdempotencyKeyRow.created_at
            unfinished = IdempotencyKeyRow.status.is_(None)
            abandoned = unfinished & (created < now - ABANDONED_AFTER)
            gone = gateway.is_gone(IdempotencyKeyRow.gateway_id)
            if gone is not None:
                abandoned |= unfinished & (created < now - ORPHANED_AFTER) & gone
            session.execute(delete(IdempotencyKeyRow).where((created < now - LIFETIME) | abandoned))
            row = session.get(IdempotencyKeyRow, claim)
            if row is None:
                principal, key = claim
                row = IdempotencyKeyRow(
                    principal=principal,
                    key=key,
                    fingerprint=fingerprint,
                    created_at=now,
                    gateway_id=gateway.id if gateway.shared else None,
                )
                session.add(row)
                session.flush()
                return None
            return _answer(row, fingerprint)
    except IntegrityError:  # another server was first
        with database.read() as session:
            row = session.get(IdempotencyKeyRow, claim)
            if row is None:
                raise _in_progress(claim[1]) from None
            return _answer(row, fingerprint)


def _answer(row: IdempotencyKeyRow, fingerprint: str) -> Response:
    if row.fingerprint != fingerprint:
        raise IdempotencyKeyReused(
            f'{NAME} "{row.key}" came with another request at {row.created_at:%H:%M:%S} UTC; send '
            "a new key with each new request, and the same request again with its own",
            key=row.key,
        )
    if row.status is None:
        raise _in_progress(row.key)
    headers = {**(row.headers or {}), "Idempotent-Replayed": "true"}
    return Response(zlib.decompress(row.body or b""), row.status, headers)


def _in_progress(key: str) -> RequestInProgress:
    return RequestInProgress(
        f'the request with {NAME} "{key}" is being carried out; ask again in {_RETRY_AFTER_S} s to '
        "get its answer",
        key=key,
    )


def _keep(database: Database, claim: tuple[str, str], response: Response) -> None:
    headers = {
        name: value for name, value in response.headers.items() if name.lower() in _KEPT_HEADERS
    }
    values = {
        "status": response.status_code,
        "headers": headers,
        "body": zlib.compress(bytes(response.body)),
    }
    with database.write() as session:
        session.execute(update(IdempotencyKeyRow).where(_is(claim)).values(values))


def _release(database: Database, claim: tuple[str, str]) -> None:
    with database.write() as session:
        session.execute(
            delete(IdempotencyKeyRow).where(_is(claim), IdempotencyKeyRow.status.is_(None))
        )


def _is(claim: tuple[str, str]) -> Any:
    principal, key = claim
    return (IdempotencyKeyRow.principal == principal) & (IdempotencyKeyRow.key == key)
