"""Outermost ASGI middleware: request id, access log and metrics."""

import logging
import re
import secrets
import time
from collections.abc import Callable
from typing import Final

from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.logs.context import RECORD, REFUSED, RequestRecord, set_request_id
from service.logs.redaction import decoded
from service.problems.catalogue import problem_type_of
from service.problems.errors import NotReady
from service.problems.handlers import problem_response, refuse_websocket

_log = logging.getLogger("service.access")

_SANE: Final = re.compile(r"[A-Za-z0-9._-]{1,64}", re.ASCII)
_STARTS: Final = ("http.response.start", "websocket.http.response.start")
_ACCEPTED: Final = 101
_SHOWN_CHARACTERS: Final = 500
_READ_CHARACTERS: Final = 4 * _SHOWN_CHARACTERS
_UNLOGGED_PATHS: Final = frozenset({"/healthz", "/readyz", "/metrics"})


class RequestLog:
    """Gives each request an id, answers 503 once the server stops, logs and counts the result.

    The answer carries the id, and so does every line that is logged within the request.
    """

    def __init__(
        self, app: ASGIApp, ended: Callable[[RequestRecord], None], stopping: Callable[[], bool]
    ) -> None:
        """Take the callback at each request's end and the test whether the server is stopping."""
        self._app = app
        self._ended = ended
        self._stopping = stopping

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        given = Headers(scope=scope).get("x-request-id", "")
        record = RequestRecord(
            given if _SANE.fullmatch(given) else secrets.token_hex(8),
            scope["type"],
            scope.get("method", "GET"),
        )
        scope[RECORD] = record
        set_request_id(record.id)
        begin = time.perf_counter()
        opened = False

        async def watched(message: Message) -> None:
            nonlocal opened
            kind = message["type"]
            if kind in _STARTS:
                record.status = message["status"]
                MutableHeaders(scope=message)["X-Request-ID"] = record.id
            elif kind == "websocket.accept":
                headers = list(message.get("headers", ()))
                message["headers"] = [*headers, (b"x-request-id", record.id.encode())]
                record.status, opened = _ACCEPTED, True
                self._log_request(scope, record, time.perf_counter() - begin)
            elif kind == "websocket.close" and record.status is None:
                record.status = 403  # what the server makes of a close before it was opened
            await send(message)

        try:
            if self._stopping():
                await _refuse(scope, receive, watched)
            else:
                await self._app(scope, receive, watched)
        except BaseException:
            # Answered by what stands around all middleware, once this is through.
            record.status = record.status or 500
            raise
        finally:
            duration_s = time.perf_counter() - begin
            if opened:
                _log.info("%s closed after %.1f s", _path(scope), duration_s)
            else:
                REFUSED.set(record.kind == "websocket" and record.status is not None)
                self._log_request(scope, record, duration_s)

    def _log_request(self, scope: Scope, record: RequestRecord, duration_s: float) -> None:
        record.duration_s = duration_s
        status = record.status or 499  # the client went before there was an answer
        client = scope.get("client")
        self._ended(record)
        level = logging.DEBUG if record.route in _UNLOGGED_PATHS and status < 400 else logging.INFO
        if _log.isEnabledFor(level):
            _log.log(
                level,
                "%s %s %d %.1f ms",
                record.method if record.kind == "http" else "WEBSOCKET",
                _target(scope),
                status,
                1e3 * duration_s,
                extra={
                    "client": client[0] if client else None,
                    "method": record.method,
                    "path": _path(scope),
                    "route": record.route,
                    "status": status,
                    "duration_s": round(duration_s, 6),
                },
            )


def _target(scope: Scope) -> str:
    """Return path and query with nothing in them that could begin a line of its own.

    Both as they are meant: what is encoded would not be known for a key, and be written down.
    """
    query = decoded(scope.get("query_string", b"")[:_READ_CHARACTERS].decode("latin-1"))
    text = _path(scope) + (f"?{query}" if query else "")
    return text.encode("unicode_escape").decode("ascii")[:_SHOWN_CHARACTERS]


def _path(scope: Scope) -> str:
    return decoded(scope["path"][:_READ_CHARACTERS])[:_SHOWN_CHARACTERS]


async def _refuse(scope: Scope, receive: Receive, send: Send) -> None:
    response = problem_response(
        problem_type_of(NotReady),
        "the server is stopping; try again when it is up again",
        scope["path"],
        context={"part": "server"},
    )
    if scope["type"] == "websocket":
        await refuse_websocket(response, scope, receive, send)
    else:
        await response(scope, receive, send)
