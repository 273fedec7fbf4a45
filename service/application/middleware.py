"""ASGI middleware: log and metrics; security headers, cross-origin refusals, HEAD, body limits."""

import logging
import re
import secrets
import time
from collections.abc import Callable, Mapping
from typing import Final
from urllib.parse import urlsplit

from anyio import fail_after
from starlette.datastructures import Headers, MutableHeaders
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.logs import RECORD, REFUSED, RequestRecord, decoded, set_request_id
from service.problems.errors import BodyTooLarge, CrossOrigin, NotReady
from service.problems.handlers import SECURITY_HEADERS, error_response, refuse

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
        request_id = Headers(scope=scope).get("x-request-id", "")
        record = RequestRecord(
            request_id if _SANE.fullmatch(request_id) else secrets.token_hex(8),
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
                stopping = "the server is stopping; try again when it is up again"
                response = error_response(NotReady(stopping, part="server"), scope["path"])
                await refuse(response, scope, receive, watched)
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


class SecurityHeadersMiddleware:
    """Says in each answer what a browser may do with it: nothing that its content does not need."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on."""

        async def with_headers(message: Message) -> None:
            if message["type"] in _STARTS:
                headers = MutableHeaders(scope=message)
                for name, value in SECURITY_HEADERS.items():
                    headers.setdefault(name, value)
            await send(message)

        await self._app(scope, receive, with_headers)


SAFE_METHODS: Final = frozenset({"GET", "HEAD", "OPTIONS"})
_PORTS: Final = {"http": 80, "https": 443}


class CrossOriginMiddleware:
    """Answers 403 to an unsafe method, or a websocket, with an ``Origin`` that is not the host.

    A browser sends some requests of a page to any server without asking it, and opens websockets
    to any server; it adds the page's origin, which a page cannot change. Programs send none.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, or refuse it."""
        if scope.get("method") in SAFE_METHODS or scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        host = headers.get("host", "")
        foreign = [origin for origin in headers.getlist("origin") if not same_host(origin, host)]
        if not foreign:
            await self._app(scope, receive, send)
            return
        error = CrossOrigin(
            f'the request comes from a web page of "{foreign[0][:200]}", the server is '
            f'"{host[:200]}"; only pages of the server itself, and programs, may ask for this'
        )
        await refuse(error_response(error, scope["path"]), scope, receive, send)


def same_host(origin: str, host: str) -> bool:
    """Whether an ``Origin`` has the host name and port of a ``Host`` header.

    The schemes are not compared: behind a proxy that ends TLS the server does not know its own.
    """
    try:
        page, server = urlsplit(origin), urlsplit(f"//{host}")
        default = _PORTS[page.scheme]
        return page.hostname is not None and (page.hostname, page.port or default) == (
            server.hostname,
            server.port or default,
        )
    except (KeyError, ValueError):  # "null", and what is no origin
        return False


class HeadMiddleware:
    """Hands HEAD requests on as GET and keeps the content of the answers back."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on."""
        if scope["type"] != "http" or scope["method"] != "HEAD":
            await self._app(scope, receive, send)
            return

        async def without_content(message: Message) -> None:
            if message["type"] == "http.response.body":
                message = {**message, "body": b""}
            await send(message)

        await self._app({**scope, "method": "GET"}, receive, without_content)


class BodyLimitMiddleware:
    """Answers 413 when the declared or the received length exceeds the path's limit.

    And 408 when the body is not there within a time: whoever sends it byte by byte would otherwise
    hold a connection for nothing.
    """

    def __init__(
        self,
        app: ASGIApp,
        limit_bytes: int,
        others: Mapping[str, int] | None = None,
        seconds: float = 60.0,
    ) -> None:
        """Limit bodies to ``limit_bytes``, on the paths of ``others`` to what stands there."""
        self._app = app
        self._seconds = seconds
        self._limit_bytes = limit_bytes
        self._others = dict(others or {})

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, counting what it receives."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        limit = self._others.get(scope["path"], self._limit_bytes)
        declared = Headers(scope=scope).get("content-length", "")
        if declared.isdecimal() and int(declared[:20]) > limit:
            error = BodyTooLarge(_detail(f"{declared[:20]} bytes", limit))
            await refuse(error_response(error, scope["path"]), scope, receive, send)
            return
        received = 0
        complete = False
        until = time.monotonic() + self._seconds

        async def counted() -> Message:
            nonlocal received, complete
            if complete:  # what comes now is the end of the connection, whenever
                return await receive()
            try:
                with fail_after(max(0.0, until - time.monotonic())):
                    message = await receive()
            except TimeoutError:
                raise HTTPException(
                    408,
                    f"the body did not arrive within {self._seconds:g} s; {received} bytes came",
                ) from None
            complete = not message.get("more_body", False)
            received += len(message.get("body", b""))
            if received > limit:
                # An HTTPException, because FastAPI turns any other one raised here into 400.
                raise HTTPException(413, _detail(f"more than {limit} bytes", limit))
            return message

        await self._app(scope, counted, send)


def _detail(size: str, limit: int) -> str:
    return f"the body has {size}; the limit is {limit} bytes"
