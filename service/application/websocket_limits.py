"""Websocket buffers and deadlines: who does not read is closed; connections open one by one.

What is no handshake is refused as other requests are, by a problem document.
"""

import asyncio
import socket
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from typing import Any, Final
from weakref import WeakKeyDictionary

from uvicorn.protocols.utils import ClientDisconnected
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from websockets.exceptions import InvalidState
from websockets.http11 import Response

from service.problems.catalogue import PROBLEM_TYPES
from service.problems.errors import MalformedRequest, UpgradeRequired
from service.problems.handlers import SECURITY_HEADERS, problem_response
from service.protocols.stream.router import SEND_MANY

SEND_BUFFER_BYTES: Final = 32 * 1024
"""Of each client, in the server and (doubled by Linux) in the kernel, where it would grow to some
MiB for one that does not read: all of that would be sent before it is seen that nobody reads."""
STALL_S: Final = 10.0
"""How long a client may read nothing, with its buffers full, before it is closed."""
LINGER_S: Final = 2.0
"""How long the close may wait behind what the client did not read."""
STALLED: Final = 1013
"""Close code: try again later (IANA registry of RFC 6455); the client may resume."""
OPENING: Final = 1
"""How many connections are opened together: each takes some ms, for which all others would wait."""
REST_S: Final = 0.04
"""Pause before the next: a new client is sent all that its buffers hold, which costs as much. 100
that connect together then lengthen the others' latency at the 99th percentile by half."""
OPENING_WAIT_S: Final = 10.0
"""How long one waits for its turn: those before it may be slow, as where the database is."""

_REFUSALS: Final = {
    400: MalformedRequest.code,
    405: "method-not-allowed",
    426: UpgradeRequired.code,
    500: "internal-error",
}

_turns: WeakKeyDictionary[asyncio.AbstractEventLoop, asyncio.Semaphore] = WeakKeyDictionary()


class LimitedWebSocketProtocol(WebSocketsSansIOProtocol):
    """Uvicorn's protocol, which would keep a client for ever that does not read."""

    def __init__(self, *positional: Any, **named: Any) -> None:
        super().__init__(*positional, **named)
        self._stalled: asyncio.TimerHandle | None = None
        self._turn: asyncio.Semaphore | None = None
        self.conn.reject = partial(_reject, self.conn.reject)  # type: ignore[method-assign]

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Bound the kernel's buffer of the connection."""
        super().connection_made(transport)
        self.transport.set_write_buffer_limits(high=SEND_BUFFER_BYTES)
        connection = transport.get_extra_info("socket")
        if connection is not None:
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES)

    def connection_lost(self, exc: Exception | None) -> None:
        """Wait no more."""
        self.resume_writing()
        super().connection_lost(exc)

    def shutdown(self) -> None:
        """Close the connection; one whose client does not read must not hold up the server."""
        super().shutdown()
        self.loop.call_later(LINGER_S, self.transport.abort)

    def pause_writing(self) -> None:
        """Begin to wait for the client to read."""
        super().pause_writing()
        if self._stalled is None and not self.close_sent:
            self._stalled = self.loop.call_later(STALL_S, self._close_stalled)

    def resume_writing(self) -> None:
        """Wait no more."""
        if self._stalled is not None:
            self._stalled.cancel()
            self._stalled = None
        super().resume_writing()

    def _close_stalled(self) -> None:
        self._stalled = None
        if self.close_sent or self.transport.is_closing():
            self.transport.abort()
            return
        reason = f"the client read nothing for {STALL_S:g} s"
        try:
            self.conn.send_close(STALLED, reason)
        except InvalidState:
            self.transport.abort()
            return
        self.transport.write(b"".join(self.conn.data_to_send()))
        self.close_sent = True
        self.stop_keepalive()
        self.queue.put_nowait({"type": "websocket.disconnect", "code": STALLED, "reason": reason})
        self.writable.set()  # who sends is refused now
        self.loop.call_later(LINGER_S, self.transport.abort)

    async def run_asgi(self) -> None:
        """Run the application, which may send many messages in one go."""
        self.scope["extensions"][SEND_MANY] = {"send": self.send_payloads}
        turns = _turns.setdefault(self.loop, asyncio.Semaphore(OPENING))
        with suppress(TimeoutError):
            async with asyncio.timeout(OPENING_WAIT_S):
                await turns.acquire()
                self._turn = turns
        try:
            await super().run_asgi()
        finally:
            self._opened()

    def _opened(self) -> None:
        """Let the next one be opened, after a rest."""
        if self._turn is not None:
            self.loop.call_later(REST_S, self._turn.release)
            self._turn = None

    async def send(self, message: Any) -> None:
        """Send what the application gives, or close the connection."""
        await super().send(message)
        if message["type"] != "websocket.accept":
            self._opened()

    async def send_payloads(self, payloads: Sequence[bytes | str]) -> None:
        """Send messages in one write, past all layers of the application between.

        Raises:
            ClientDisconnected: the connection is closed.
        """
        await self.writable.wait()
        if self.disconnected or self.close_sent:
            raise ClientDisconnected
        try:
            for payload in payloads:
                if isinstance(payload, bytes):
                    self.conn.send_binary(payload)
                else:
                    self.conn.send_text(payload.encode())
        except InvalidState:
            raise ClientDisconnected from None
        self.transport.write(b"".join(self.conn.data_to_send()))


def _reject(reject: Callable[[Any, str], Response], status: int, text: str) -> Response:
    """Refuse a handshake by a problem document, with the headers that all answers have."""
    response = reject(status, text)
    changed = dict(SECURITY_HEADERS)
    if status in _REFUSALS:
        detail = text.partition("\n")[0]
        problem = problem_response(PROBLEM_TYPES[_REFUSALS[status]], detail, "/")
        response.body = bytes(problem.body)
        changed |= {
            "Content-Type": problem.headers["content-type"],
            "Content-Length": str(len(response.body)),
        }
    for name, value in changed.items():
        if name in response.headers:
            del response.headers[name]  # else there would be two
        response.headers[name] = value
    return response
