"""Header size and arrival limits of HTTP/1.1; the longest-waiting connection is evicted."""

import asyncio
from typing import Any, Final

from starlette.types import Receive, Scope, Send
from uvicorn.protocols.http.httptools_impl import STATUS_LINE, HttpToolsProtocol

from compute.errors import LumilineError
from service.problems.errors import Busy, HeadTooLarge, HeadTooSlow, MalformedRequest
from service.problems.handlers import SECURITY_HEADERS, error_response

HEAD_S: Final = 10.0
"""Within which a request's head has to arrive."""
HEAD_BYTES: Final = 64 * 1024
"""Largest head: the request line and all headers."""
MAX_HEADERS: Final = 100
"""Headers of one request, trailers with them: each costs more than its bytes."""
_HEADERS: Final = {**SECURITY_HEADERS, "Connection": "close"}


class LimitedHttpProtocol(HttpToolsProtocol):
    """Uvicorn's protocol, which would wait for ever for a head of any size.

    Bodies have limits of their own (service/application/middleware.py).

    What it answers itself no middleware sees; it has the security headers all the same.
    """

    def __init__(self, *positional: Any, **named: Any) -> None:
        super().__init__(*positional, **named)
        self._application = self.app
        self._max_at_once = self.limit_concurrency
        self.limit_concurrency = None  # Uvicorn would answer in plain text
        self._waiting: asyncio.TimerHandle | None = None
        self._head_bytes = 0
        self._in_head = True
        self._too_large = False
        self._upgraded = False

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Wait for the first head; with too many connections, evict the longest waiting."""
        super().connection_made(transport)
        self._wait()
        if self._max_at_once is not None and len(self.connections) >= self._max_at_once:
            self._make_room()

    def connection_lost(self, exc: Exception | None) -> None:
        """Wait no more."""
        self._wait_no_more()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Take data, of a head no more than it may have."""
        if self._in_head:
            self._head_bytes += len(data)
        super().data_received(data)
        if self._upgraded or self.transport.is_closing():
            return
        if self._in_head and self._head_bytes:
            if self._head_bytes > HEAD_BYTES:
                self._refuse(_too_large())
            elif self._waiting is None:
                self._wait()

    def on_header(self, name: bytes, value: bytes) -> None:
        """Take a header, or a trailer, unless there are too many."""
        super().on_header(name, value)
        if len(self.headers) > MAX_HEADERS:
            self._too_large = True
            raise ValueError("too many headers")  # the parser's error: see send_400_response

    def on_headers_complete(self) -> None:
        """Begin with a request whose head is there."""
        self._wait_no_more()
        self._in_head = False
        headers = sum(len(name) + len(value) for name, value in self.headers)
        if len(self.url) + headers > HEAD_BYTES:
            self._too_large = True
            raise ValueError("too large a head")  # the parser's error: see send_400_response
        if self._has_room():
            self.app = self._application
        else:
            self.logger.warning("%d connections or requests at once: refused", self._max_at_once)
            self.app = _too_many
        super().on_headers_complete()

    def on_message_complete(self) -> None:
        """Expect another head after the body."""
        super().on_message_complete()
        self._in_head = True
        self._head_bytes = 0

    def handle_websocket_upgrade(self) -> None:
        """Leave the connection to the websocket's protocol."""
        self._upgraded = True
        super().handle_websocket_upgrade()

    def send_400_response(self, msg: str) -> None:
        """Answer what is no HTTP, or has too large a head, with a problem document."""
        self._refuse(_too_large() if self._too_large else MalformedRequest(msg))

    def _wait(self) -> None:
        self._waiting = self.loop.call_later(HEAD_S, self._too_slow)

    def _wait_no_more(self) -> None:
        if self._waiting is not None:
            self._waiting.cancel()
            self._waiting = None

    def _too_slow(self) -> None:
        self._waiting = None
        if self.cycle is not None and not self.cycle.response_complete:
            self._wait()  # a request before it is still being answered
        elif self._head_bytes:
            self._refuse(HeadTooSlow(f"the head did not arrive within {HEAD_S:g} s; send again"))
        else:
            self.transport.close()

    def _has_room(self) -> bool:
        at_once = max(len(self.connections), len(self.tasks))
        return self._max_at_once is None or at_once < self._max_at_once

    def _make_room(self) -> None:
        waiting = [
            (one._waiting.when(), one)
            for one in self.connections
            if isinstance(one, LimitedHttpProtocol) and one is not self and one._waiting is not None
        ]
        if waiting:
            _, oldest = min(waiting, key=lambda pair: pair[0])
            oldest.transport.close()
            self.connections.discard(oldest)

    def _refuse(self, error: LumilineError) -> None:
        if self.cycle is not None and not self.cycle.response_complete:
            self.transport.close()  # an answer in between would be taken for the other's
            return
        response = error_response(error, "/", _HEADERS)  # the path may be what did not come
        headers = b"".join(b"%s: %s\r\n" % header for header in response.raw_headers)
        head = STATUS_LINE[response.status_code] + headers
        self.transport.write(head + b"\r\n" + response.body)
        self.transport.close()


async def _too_many(scope: Scope, receive: Receive, send: Send) -> None:
    """Answer a request that is one too many."""
    error = Busy("the server has as many connections or requests as it may; try again later")
    await error_response(error, scope["path"], _HEADERS)(scope, receive, send)


def _too_large() -> HeadTooLarge:
    return HeadTooLarge(
        f"the request line and the headers have more than {HEAD_BYTES} bytes, or there are more "
        f"than {MAX_HEADERS} headers; send fewer"
    )
