"""One connection: bytes in and out, and no more of either than the client keeps up with."""

import asyncio
import logging
import socket
import time
from collections.abc import Callable, Coroutine, Iterable
from typing import Final, Protocol, cast

from service.protocols.openigtlink.bodies import StatusCode
from service.protocols.openigtlink.counters import Counters
from service.protocols.openigtlink.handlers import KNOWN, MessageHandlers
from service.protocols.openigtlink.host import ServerSettings
from service.protocols.openigtlink.message import (
    BadMessage,
    Damaged,
    Decoder,
    Event,
    Message,
    Skipped,
    WrongChecksum,
    write_message,
)
from service.protocols.openigtlink.session import Session
from service.protocols.openigtlink.snapshot import Snapshot

_log = logging.getLogger(__name__)

_WRITE_QUEUE_BYTES: Final = 16 * 1024
"""Of what is written and not yet sent, above which a client counts as stalled."""
_SOCKET_BYTES: Final = 64 * 1024
"""The same in the operating system: what lies there gets old."""
_MESSAGES_PER_STEP: Final = 32
"""Messages of one client that are answered before it is somebody else's turn."""
_BURST_S: Final = 0.5
"""How much a client may be behind its rate and then catch up: arrivals are never quite even."""
_CLOSING_S: Final = 1.0
_OTHER: Final = "other"
_TOLD_BY_SERVER: Final = ("shutdown", "refused")


class ConnectionOwner(Protocol):
    """Server of a connection: admits it, handles its messages, and learns of its end."""

    counters: Counters
    settings: ServerSettings
    handlers: MessageHandlers

    def admit(self, client: "ClientConnection") -> tuple[str, StatusCode | None] | None:
        """Let a client in, or say why not."""
        ...

    def forget(self, client: "ClientConnection") -> None:
        """Note that a connection has ended."""
        ...

    def greet(self, client: "ClientConnection") -> None:
        """Send the states of all beam holds to a client."""
        ...

    def spawn(self, work: Coroutine[None, None, None]) -> None:
        """Begin a task and keep it."""
        ...


class ClientConnection(asyncio.Protocol):
    """One client; lives in the event loop.

    A frame that it cannot take now waits, and is replaced by a newer one: nothing queues up.

    Args:
        server: lets it in, answers it, and is told when it reads again and when it has ended.
    """

    def __init__(self, server: ConnectionOwner) -> None:
        self._server = server
        self._settings = server.settings
        self._counters = server.counters
        self._misses_holds = False
        self._loop = asyncio.get_running_loop()
        self._decoder = Decoder(KNOWN)
        self._transport: asyncio.Transport | None = None
        self._ending: str | None = None
        self._writable = True
        self._waiting: Snapshot | None = None
        self._next_s = 0.0
        self._timers: dict[str, asyncio.TimerHandle] = {}
        self._busy = False
        self._skipped: set[str] = set()
        self._again = False
        self.session = Session("unknown")

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Begin, or refuse to."""
        self._transport = cast("asyncio.Transport", transport)
        peer = transport.get_extra_info("peername")
        self.session.address = str(peer[0]) if peer else "unknown"
        self._transport.set_write_buffer_limits(high=_WRITE_QUEUE_BYTES, low=0)
        link = transport.get_extra_info("socket")
        link.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SOCKET_BYTES)
        link.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        refused = self._server.admit(self)
        if refused is None:
            return
        reason, code = refused
        if code is None:
            self._ending = reason
            self._transport.abort()
        else:
            self.end(reason, code, "refused")

    def data_received(self, data: bytes) -> None:
        """Take bytes, and answer the messages that they complete."""
        if self._ending is None:
            self._decoder.feed(data)
            self._work()

    def eof_received(self) -> bool:
        """Close: whoever sends no more reads no more, by the protocol's own clients."""
        return False

    def pause_writing(self) -> None:
        """Take note that the client does not read."""
        self._writable = False
        self._timer("stall", self._settings.stall_s, self._stalled)

    def resume_writing(self) -> None:
        """Go on with the newest frame, and with what it asked."""
        self._writable = True
        self._cancel("stall")
        if self._misses_holds:
            self._misses_holds = False
            self._server.greet(self)
        self._send_frame()
        self._work()

    def connection_lost(self, exc: Exception | None) -> None:
        """End; the reason is in the log and in the counters."""
        for timer in self._timers.values():
            timer.cancel()
        self._timers.clear()
        self._waiting = None
        reason = self._ending or ("closed by the client" if exc is None else "connection lost")
        self._ending = reason
        self._server.forget(self)

    @property
    def ending(self) -> str:
        """Why the connection ends, or has."""
        return self._ending or "open"

    def offer(self, snapshot: Snapshot) -> None:
        """Give the client a frame: now, or when it can take it, if no newer one is there then."""
        if self._waiting is not None:
            self._counters.frames_replaced += 1
        self._waiting = snapshot
        self._send_frame()

    def send_stale(self, device_id: str, age_s: float) -> None:
        """Tell the client once that no frames come."""
        if self._writable:
            self._write(self.session.stale(device_id, age_s))

    def send_beam_hold(self, status: Message) -> None:
        """Send a beam hold's state; a client that does not read gets all states when it does."""
        if self._writable:
            self._send((status,))
        else:
            self._misses_holds = True

    def end(self, reason: str, code: StatusCode, word: str = "error") -> None:
        """Tell the client why by STATUS, if it reads, and close the connection.

        Args:
            reason: for the log and the client.
            code: of the STATUS.
            word: for the counters: what kind of reason it is.
        """
        if self._ending is not None or self._transport is None:
            return
        self._write(self.session.status_bytes(code, word, reason))
        self._ending = word
        if word not in _TOLD_BY_SERVER:
            _log.warning("OpenIGTLink client %s: %s", self.session.address, reason)
        self._transport.close()
        self._timer("close", _CLOSING_S, self._transport.abort)

    def _stalled(self) -> None:
        if self._transport is None or self._ending is not None:
            return
        self._ending = "stalled"
        _log.warning(
            "OpenIGTLink client %s: it has read nothing for %g s, and is disconnected",
            self.session.address,
            self._settings.stall_s,
        )
        self._transport.abort()

    def _slow(self) -> None:
        text = f"a message has not come to its end within {self._settings.message_s:g} s"
        self.end(text, StatusCode.TIME_OUT, "slow")

    def _send_frame(self) -> None:
        if self._waiting is None or not self._writable or self._ending is not None:
            return
        if not self._waiting.fresh:
            self._waiting = None
            self._counters.frames_stale += 1
            return
        # Not the loop's own time, which may have a resolution of milliseconds.
        now = time.monotonic()
        if now < self._next_s:
            if "rate" not in self._timers:
                self._timer("rate", self._next_s - now, self._send_frame)
            return
        self._cancel("rate")
        snapshot, self._waiting = self._waiting, None
        self._next_s = max(self._next_s, now - _BURST_S) + 1.0 / self._settings.rate_hz
        self._counters.frames_sent += 1
        self._counters.poses_withheld += sum(not pose.valid for pose in snapshot.poses)
        self._write(self.session.frame(snapshot, now, invalid=self._settings.send_invalid))

    def _work(self) -> None:
        """Answer what came, as long as the client takes the answers."""
        if self._busy or self._again or self._ending is not None:
            return
        for _ in range(_MESSAGES_PER_STEP):
            if not self._writable:
                self._read(on=False)
                return
            try:
                event = self._decoder.take()
            except BadMessage as error:
                self.end(error.detail, StatusCode.UNKNOWN_INSTRUCTION, "malformed")
                return
            if event is None:
                self._watch()
                self._read(on=True)
                return
            self._cancel("message")
            self._handle(event)
            if self._busy or self._ending is not None:
                self._read(on=False)
                return
        self._read(on=False)
        self._again = True
        self._loop.call_soon(self._continue)

    def _continue(self) -> None:
        self._again = False
        self._work()

    def _handle(self, event: Event) -> None:
        header = event if isinstance(event, Message) else event.header
        message_type = header.type if header.type in KNOWN else _OTHER
        self._counters.received[message_type] += 1
        if isinstance(event, Damaged):
            self._refuse(event.reason)
            return
        self.session.received(header)
        if isinstance(event, Skipped):
            self._skip(header.type)
            return
        try:
            answers = self._server.handlers.handle(self.session, event)
        except BadMessage as error:
            self._refuse(error)
            return
        if answers is None:
            self._busy = True
            self._server.spawn(self._later(event))
        else:
            self._send(answers)

    def _skip(self, kind: str) -> None:
        """Log each unknown type once: some clients send many of them."""
        if kind not in self._skipped and len(self._skipped) < _MESSAGES_PER_STEP:
            self._skipped.add(kind)
            text = f"{kind} is not understood here, and is skipped"
            self._write(self.session.status_bytes(StatusCode.UNKNOWN_INSTRUCTION, "Unknown", text))

    async def _later(self, message: Message) -> None:
        try:
            self._send(await self._server.handlers.handle_slow(self.session, message))
        except BadMessage as error:
            self._refuse(error)
        except Exception:  # noqa: BLE001 - one message ends no connection, and no others'
            _log.exception("OpenIGTLink client %s: %s", self.session.address, message.type)
        finally:
            self._busy = False
        self._work()

    def _refuse(self, error: BadMessage) -> None:
        self._counters.damaged += 1
        wrong = isinstance(error, WrongChecksum)
        code = StatusCode.CHECKSUM_ERROR if wrong else StatusCode.UNKNOWN_INSTRUCTION
        self._write(
            self.session.status_bytes(code, "Checksum" if wrong else "BadMessage", error.detail)
        )

    def _send(self, messages: Iterable[Message]) -> None:
        self._write(b"".join(map(write_message, messages)))

    def _write(self, data: bytes) -> None:
        if data and self._transport is not None and self._ending is None:
            self._transport.write(data)

    def _read(self, *, on: bool) -> None:
        if self._transport is None or self._transport.is_closing():
            return
        if on == self._transport.is_reading():
            return
        if on:
            self._transport.resume_reading()
        else:
            self._transport.pause_reading()

    def _watch(self) -> None:
        """Let a message that has begun come to its end in time, however slowly it drips in."""
        if not self._decoder.partial:
            self._cancel("message")
        elif "message" not in self._timers:
            self._timer("message", self._settings.message_s, self._slow)

    def _timer(self, name: str, seconds: float, call: Callable[[], object]) -> None:
        def run() -> None:
            self._timers.pop(name, None)
            call()

        self._cancel(name)
        self._timers[name] = self._loop.call_later(seconds, run)

    def _cancel(self, name: str) -> None:
        timer = self._timers.pop(name, None)
        if timer is not None:
            timer.cancel()
