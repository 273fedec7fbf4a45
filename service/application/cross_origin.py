"""ASGI middleware that refuses what a web page of another origin asks a browser to do here."""

from typing import Final
from urllib.parse import urlsplit

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Receive, Scope, Send

from service.problems.catalogue import problem_type_of
from service.problems.errors import CrossOrigin
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
