"""Header size and arrival limits of HTTP/1.1; the longest-waiting connection is evicted."""

import asyncio
from typing import Any, Final

from uvicorn.protocols.http.httptools_impl import STATUS_LINE, HttpToolsProtocol

from compute.errors import LumilineError
from service.problems.catalogue import MEDIA_TYPE
from service.problems.errors import HeadTooLarge, HeadTooSlow, MalformedRequest
from service.problems.handlers import error_response

HEAD_S: Final = 10.0
"""Within which a request's head has to arrive."""
HEAD_BYTES: Final = 64 * 1024
"""Largest head: the request line and all headers."""
MAX_HEADERS: Final = 100
"""Headers of one request, trailers with them: each costs more than its bytes."""


class LimitedHttpProtocol(HttpToolsProtocol):
    """Uvicorn's protocol, which would wait for ever for a head of any size.

    Bodies have limits of their own (service/application/middleware.py).
    """

    def __init__(self, *positional: Any, **named: Any) -> None:
        super().__init__(*positional, **named)
        self._waiting: asyncio.TimerHandle | None = None
        self._head_bytes = 0
        self._in_head = True
        self._too_large = False
        self._upgraded = False

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Wait for the first head; with too many connections, evict the longest waiting."""
        super().connection_made(transport)
        self._wait()
        if self.limit_concurrency is not None and len(self.connections) >= self.limit_concurrency:
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
        response = error_response(error, "/")  # the path may be what did not come
        body = response.body
        self.transport.write(
            b"%scontent-type: %s\r\ncontent-length: %d\r\nconnection: close\r\n\r\n%s"
            % (STATUS_LINE[response.status_code], MEDIA_TYPE.encode(), len(body), body)
        )
        self.transport.close()


def _too_large() -> HeadTooLarge:
    return HeadTooLarge(
        f"the request line and the headers have more than {HEAD_BYTES} bytes, or there are more "
        f"than {MAX_HEADERS} headers; send fewer"
    )
