"""State of a stream over its connections: resumption, repeated messages, reconnection."""

import json
from dataclasses import dataclass, field
from typing import Any, Final, Literal, Self
from urllib.parse import urlencode

import msgpack
from websockets.exceptions import (
    ConnectionClosed,
    InvalidHandshake,
    InvalidMessage,
    InvalidStatus,
)

from lumiline.client.errors import (
    ServerUnreachable,
    StreamEnded,
    UnreadableMessage,
    server_problem,
)
from lumiline.client.messages import (
    BeamHoldEvent,
    DeviceState,
    Frame,
    Hello,
    Message,
    Missed,
    UnknownMessage,
    messages_of,
)
from lumiline.client.server import Server

Content = Literal["points", "peaks", "tracks", "tools", "holds", "state"]
Mode = Literal["live", "lossless"]

POLICY_CLOSE: Final = 1008
_BACKOFF_S: Final = (0.05, 0.1, 0.2, 0.5, 1.0, 2.0)
_RETRYABLE_STATUS: Final = frozenset({429, 500, 502, 503, 504})
MAX_MESSAGE_BYTES: Final = 2**26
"""Largest message accepted; a bundle of 512 frames with all content is below a tenth of it."""


@dataclass(frozen=True)
class StreamRequest:
    """Query of a stream: device, content, mode and rate, as of ``Client.stream``."""

    device: str
    content: tuple[Content, ...] = ("points",)
    mode: Mode = "live"
    rate_hz: float | None = None
    bundle_ms: float | None = None
    encoding: Literal["msgpack", "json"] = "msgpack"

    def query(self, stream: str | None, after: int | None) -> str:
        """Return the URL query of a connection; a lossless one resumes after a message."""
        values: dict[str, Any] = {
            "device_id": self.device,
            "content": ",".join(self.content),
            "encoding": self.encoding,
            "mode": self.mode,
            "rate_hz": self.rate_hz,
            "bundle_ms": self.bundle_ms,
        }
        if self.mode == "lossless" and stream is not None and after is not None:
            values |= {"stream": stream, "after": after}
        return urlencode({name: value for name, value in values.items() if value is not None})


@dataclass
class StreamState:
    """State of a stream over all of its connections.

    Args:
        server: where it comes from.
        request: its query.
        reconnect_s: how long a lost connection is tried again [s]; 0: not at all.
        stream: id of the server's numbered messages, from ``resume``; None: from now on.
        last: number of the last message that was received.
        last_taken: number of the last message that the program has taken.
        hello: the first message of the newest connection.
        reconnections: connections that were made again after a loss.
        deleted: whether the device was, which ends the stream.
    """

    server: Server
    request: StreamRequest
    reconnect_s: float = 30.0
    stream: str | None = None
    last: int | None = None
    last_taken: int | None = None
    hello: Hello | None = None
    reconnections: int = 0
    deleted: bool = False
    _lost_at_s: float | None = field(default=None, repr=False)
    _tries: int = field(default=0, repr=False)

    @classmethod
    def begin(
        cls,
        server: Server,
        request: StreamRequest,
        resume: tuple[str, int] | None = None,
        reconnect_s: float = 30.0,
    ) -> Self:
        """Return the state of a stream before its first connection.

        ``resume`` is the stream's id and the number of the last message that the program has.

        Raises:
            ValueError: only a lossless stream goes on where another ended.
        """
        if resume is not None and request.mode != "lossless":
            raise ValueError("only a lossless stream goes on where another ended")
        stream, last = resume or (None, None)
        return cls(server, request, reconnect_s, stream, last)

    def take(self, message: Message) -> Message:
        """Return a message that the program takes now, and note its number."""
        if isinstance(message, Frame | DeviceState | BeamHoldEvent):
            self.last_taken = message.n
        elif isinstance(message, Missed):
            self.last_taken = message.last
        return message

    @property
    def url(self) -> str:
        """Address of the next connection."""
        return f"{self.server.stream_url}?{self.request.query(self.stream, self.last)}"

    @property
    def options(self) -> dict[str, Any]:
        """Options with which either websocket client connects."""
        return {
            "additional_headers": self.server.stream_headers,
            "subprotocols": self.server.stream_subprotocols,
            "compression": None,
            "max_size": MAX_MESSAGE_BYTES,
            "close_timeout": 2.0,
        }

    def decode(self, payload: bytes | str) -> list[Message]:
        """Return the messages of a payload that have not been received yet.

        Raises:
            UnreadableMessage: the payload is no message of a stream.
        """
        found = []
        for message in messages_of(_unpack(payload)):
            if isinstance(message, Hello):
                self._handle_hello(message)
            elif isinstance(message, Frame | DeviceState | BeamHoldEvent):
                # After a lost connection the server may repeat; a program gets everything once.
                if self.last is not None and message.n <= self.last:
                    continue
                self.last = message.n
                if isinstance(message, DeviceState):
                    self.deleted = message.state == "deleted"
            elif isinstance(message, Missed):
                self.last = message.last
            elif isinstance(message, UnknownMessage):
                number = message.members.get("n")
                self.last = number if isinstance(number, int) else self.last
            found.append(message)
        return found

    def _handle_hello(self, hello: Hello) -> None:
        if self._lost_at_s is not None:
            self.reconnections += 1
        self._lost_at_s, self._tries = None, 0
        if hello.stream != self.stream or not hello.resumed:
            self.last = hello.next - 1
        self.stream, self.hello = hello.stream, hello

    def wait_after(self, error: Exception, now_s: float) -> float | None:
        """Time to wait before the next connection [s]; None: the stream has ended.

        Args:
            error: what ended the connection, or kept it from being made.
            now_s: time of a monotonic clock [s].

        Raises:
            StreamEnded: the key was revoked or has expired.
            ServerProblem: the server refused, and would again.
            ServerUnreachable: the first connection failed, or ``reconnect_s`` has passed.
        """
        if self.deleted:
            return None
        closed = error.rcvd if isinstance(error, ConnectionClosed) else None
        if closed is not None and closed.code == POLICY_CLOSE:
            raise StreamEnded(closed.code, closed.reason) from error
        first = self.hello is None  # no connection was made yet: failures are raised at once
        if isinstance(error, InvalidStatus):
            response = error.response
            status, body = response.status_code, bytes(response.body or b"")
            if first or status not in _RETRYABLE_STATUS:
                raise server_problem(status, body, response.headers.get("Retry-After")) from error
        lost_at_s = self._lost_at_s = now_s if self._lost_at_s is None else self._lost_at_s
        if first or now_s - lost_at_s >= self.reconnect_s:
            raise ServerUnreachable(
                f"the stream of {self.server.url} "
                f"{'could not be opened' if first else 'was lost'}: {error or type(error).__name__}"
            ) from error
        wait = _BACKOFF_S[min(self._tries, len(_BACKOFF_S) - 1)]
        self._tries += 1
        return min(wait, max(lost_at_s + self.reconnect_s - now_s, 0.0))


CONNECTION_FAILURES: Final = (OSError, ConnectionClosed, InvalidHandshake, InvalidMessage, EOFError)
"""What the websocket library raises when a connection is lost or is not made."""


def _unpack(payload: bytes | str) -> object:
    loads: Any = json.loads if isinstance(payload, str) else msgpack.unpackb
    try:
        found: object = loads(payload)
    except (ValueError, msgpack.UnpackException) as error:
        raise UnreadableMessage(f"a message of the stream cannot be decoded: {error}") from error
    return found
