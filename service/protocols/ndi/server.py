"""NdiServer: serves NDI clients on a TCP port, in the asyncio loop."""

import asyncio
import logging
import socket
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Final

from service.allow_list import AllowList
from service.protocols.ndi.client_state import Identity
from service.protocols.ndi.command import CommandReader
from service.protocols.ndi.pose_feed import PoseFeed
from service.protocols.ndi.session import Session

_log = logging.getLogger(__name__)

READ_BYTES: Final = 4096
WRITE_BUFFER_BYTES: Final = 16_384
"""Replies that may wait for the client to read them; then its commands wait."""
STALLED_S: Final = 10.0
"""How long they wait until the connection is ended."""
POSE_WAIT_S: Final = 0.02
"""How long who asks again for the frame that it has waits for another, before it gets it again."""


class ClientConnection:
    """Serves a connection.

    Attributes:
        session: its conversation.
        leaving: whether it was told to go.
    """

    def __init__(
        self,
        name: str,
        session: Session,
        feed: PoseFeed,
        reader: asyncio.StreamReader,
        writer: asyncio.StreamWriter,
    ) -> None:
        self.session = session
        self.leaving = False
        self._name = name
        self._feed = feed
        self._reader = reader
        self._writer = writer
        self._logged = 0
        writer.transport.set_write_buffer_limits(high=WRITE_BUFFER_BYTES)

    async def serve(self) -> str:
        """Answer until the connection ends; return why it did."""
        lines = CommandReader()
        try:
            while data := await self._reader.read(READ_BYTES):
                for received in lines.feed(data):
                    if self.session.repeats(received):
                        state = self.session.state
                        await self._feed.newer(state.device, state.reported, POSE_WAIT_S)
                    self._writer.write(self.session.answer(received))
                    async with asyncio.timeout(STALLED_S):
                        await self._writer.drain()
                self._log_problems()
                # A client that never lets its commands run out lets others have their turn.
                await asyncio.sleep(0)
            # What it asked for last is still sent.
            self._writer.close()
            async with asyncio.timeout(STALLED_S):
                await self._writer.wait_closed()
        except TimeoutError:
            return f"read none of its replies for {STALLED_S:g} s"
        except OSError as error:
            return f"gone ({error})"
        finally:
            self.end()
        return "disconnected"

    def end(self) -> None:
        """End the connection at once; what the client has not read is thrown away."""
        self.leaving = True
        self._writer.transport.abort()

    def _log_problems(self) -> None:
        for text in self.session.state.problems[self._logged :]:
            _log.warning("NDI client %s: %s", self._name, text)
        self._logged = len(self.session.state.problems)


@dataclass(frozen=True)
class NdiOptions:
    """Options of the NDI server; see the settings of the service that begin with ndi."""

    port: int
    host: str = "127.0.0.1"
    allowed: AllowList = field(default_factory=AllowList)
    clients: int = 16
    model: str = "Lumiline Polaris-compatible"
    version: str = "0"
    part_numbers: Mapping[str, str] = field(default_factory=dict)


@dataclass
class NdiCounts:
    """Counters since the start."""

    connections: int = 0
    rejected_connections: int = 0
    commands: int = 0
    refused: int = 0


class NdiServer:
    """Answers many clients; each has a state of its own, and none can hold up another.

    Attributes:
        counts: what happened since the start, of clients that have gone; see ``totals``.
        address: address and port where it listens.
    """

    def __init__(self, options: NdiOptions, feed: PoseFeed) -> None:
        self.counts = NdiCounts()
        self.address = options.host, options.port
        self._options = options
        self._feed = feed
        self._server: asyncio.Server | None = None
        self._clients: dict[asyncio.Task[None], ClientConnection] = {}

    @property
    def clients(self) -> int:
        """Number of connected clients."""
        return len(self._clients)

    def totals(self) -> NdiCounts:
        """Return the counters since the start, those of connected clients included."""
        sessions = [client.session for client in self._clients.values()]
        return replace(
            self.counts,
            commands=self.counts.commands + sum(one.answered for one in sessions),
            refused=self.counts.refused + sum(one.refused for one in sessions),
        )

    async def start(self) -> None:
        """Listen; raises OSError when the port cannot be had."""
        self._server = await asyncio.start_server(
            self._connected, self._options.host, self._options.port, limit=READ_BYTES
        )
        address = self._server.sockets[0].getsockname()
        self.address = str(address[0]), int(address[1])
        _log.info("NDI clients: listening on %s port %d", *self.address)

    async def close(self) -> None:
        """End all connections, and listen no longer."""
        self._feed.close()
        if self._server is None:
            return
        self._server.close()
        tasks = list(self._clients)
        for client in self._clients.values():
            client.end()
        await asyncio.gather(*tasks)
        await self._server.wait_closed()

    async def _connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        try:
            host = str((writer.get_extra_info("peername") or ("?",))[0])
            if not self._accept_from(host):
                self.counts.rejected_connections += 1
                return
            self.counts.connections += 1
            _keep_alive(writer)
            client = ClientConnection(host, self._session(), self._feed, reader, writer)
            self._clients[task] = client
            _log.info("NDI client %s: connected", host)
            reason = await client.serve()
            _log.info("NDI client %s: %s", host, reason)
        finally:
            if (ended := self._clients.pop(task, None)) is not None:
                self.counts.commands += ended.session.answered
                self.counts.refused += ended.session.refused
            writer.transport.abort()

    def _session(self) -> Session:
        identity = Identity(self._options.model, self._options.version, "LUMILINE")
        return Session(identity, self._feed.look, self._options.part_numbers)

    def _accept_from(self, host: str) -> bool:
        """Return whether a connection is taken; for one more, a client that is none may go."""
        if not self._options.allowed.permits(host):
            _log.warning("NDI client %s: not in ndi_allow, turned away", host)
            return False
        staying = [client for client in self._clients.values() if not client.leaving]
        if len(staying) < self._options.clients:
            return True
        silent = next((client for client in staying if not client.session.answered), None)
        if silent is not None:
            silent.end()
            return True
        _log.warning("NDI client %s: turned away, there are %d", host, len(self._clients))
        return False


def _keep_alive(writer: asyncio.StreamWriter) -> None:
    """Have the system notice clients that are gone without a word."""
    connection = writer.get_extra_info("socket")
    if connection is not None:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
