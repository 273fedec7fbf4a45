"""ASGI middleware: cross-origin refusals, HEAD requests, body size and time limits."""

import time
from collections.abc import Mapping
from typing import Final
from urllib.parse import urlsplit

from anyio import fail_after
from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.problems.catalogue import problem_type_of
from service.problems.errors import BodyTooLarge, CrossOrigin
from service.problems.handlers import problem_response, refuse_websocket

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
        websocket = scope["type"] == "websocket"
        if not websocket and (scope["type"] != "http" or scope["method"] in SAFE_METHODS):
            await self._app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        host = headers.get("host", "")
        foreign = [found for found in headers.getlist("origin") if not same_host(found, host)]
        if not foreign:
            await self._app(scope, receive, send)
            return
        response = problem_response(
            problem_type_of(CrossOrigin),
            f'the request comes from a web page of "{foreign[0][:200]}", the server is '
            f'"{host[:200]}"; only pages of the server itself, and programs, may ask for this',
            scope["path"],
        )
        if websocket:
            await refuse_websocket(response, scope, receive, send)
        else:
            await response(scope, receive, send)


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
            await self._refusal(scope, f"{declared[:20]} bytes", limit)(scope, receive, send)
            return
        received = 0
        whole = False
        until = time.monotonic() + self._seconds

        async def counted() -> Message:
            nonlocal received, whole
            if whole:  # what comes now is the end of the connection, whenever
                return await receive()
            try:
                with fail_after(max(0.0, until - time.monotonic())):
                    message = await receive()
            except TimeoutError:
                raise HTTPException(
                    408,
                    f"the body did not arrive within {self._seconds:g} s; {received} bytes came",
                ) from None
            whole = not message.get("more_body", False)
            received += len(message.get("body", b""))
            if received > limit:
                # An HTTPException, because FastAPI turns any other one raised here into 400.
                raise HTTPException(413, _detail(f"more than {limit} bytes", limit))
            return message

        await self._app(scope, counted, send)

    def _refusal(self, scope: Scope, size: str, limit: int) -> ASGIApp:
        kind = problem_type_of(BodyTooLarge)
        return problem_response(kind, _detail(size, limit), scope["path"])


def _detail(size: str, limit: int) -> str:
    return f"the body has {size}; the limit is {limit} bytes"
