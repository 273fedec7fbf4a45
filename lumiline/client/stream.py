"""Stream and AsyncStream: a device's messages as an iterator, over lost connections."""

import asyncio
import time
from collections import deque
from collections.abc import AsyncIterator, Iterator
from contextlib import ExitStack
from typing import Any, Generic, Literal, Self, TypeVar

from websockets.asyncio import client as asyncio_client
from websockets.sync import client as blocking_client

from lumiline.client.exchange import AsyncRunner, BlockingRunner, Exchange, Pause
from lumiline.client.messages import Frame, Hello, Message
from lumiline.client.stream_state import CONNECTION_FAILURES, StreamState

Socket = TypeVar("Socket", blocking_client.ClientConnection, asyncio_client.ClientConnection)
Step = Literal["open", "receive", "close"] | Pause


class _SharedStream(Generic[Socket]):
    """State and messages of a stream; its subclasses add input and output."""

    def __init__(self, state: StreamState, open_timeout_s: float = 10.0) -> None:
        """Make a stream that is opened by its first message, or by entering it."""
        self._state = state
        self._timeout_s = open_timeout_s
        self._socket: Socket | None = None
        self._received: deque[Message] = deque()
        self._closed = False

    @property
    def hello(self) -> Hello | None:
        """The first message of the newest connection."""
        return self._state.hello

    @property
    def last(self) -> int | None:
        """Number of the last message that the program has taken, to go on with ``resume``."""
        return self._state.last_taken

    @property
    def reconnections(self) -> int:
        """Connections that were made again after a loss."""
        return self._state.reconnections

    def _receive(self) -> Exchange[bool]:
        """Receive until there is a message; False: there will be none."""
        while not self._received:
            if self._closed:
                return False
            try:
                if self._socket is None:
                    yield "open"
                if self._closed:  # by another thread, while the connection was made
                    yield "close"
                    return False
                payload = yield "receive"
                self._received.extend(self._state.decode(payload))
            except CONNECTION_FAILURES as error:
                yield "close"
                if self._closed:
                    return False
                wait_s = self._state.wait_after(error, time.monotonic())
                if wait_s is None:
                    self._closed = True
                    return False
                yield Pause(wait_s)
        return True

    def _take(self) -> Message:
        return self._state.take(self._received.popleft())

    def _connection(self) -> Socket:
        socket = self._socket
        if socket is None:
            raise EOFError("another thread has closed the stream")
        return socket

    @property
    def _options(self) -> dict[str, Any]:
        return {"open_timeout": self._timeout_s, **self._state.options}


class Stream(_SharedStream[blocking_client.ClientConnection], BlockingRunner):
    """Messages of a device, one after another; a context manager that closes the connection.

    Ends when the device is deleted. A connection that is lost is made again; then comes another
    ``Hello``.
    """

    def __init__(self, state: StreamState, open_timeout_s: float = 10.0) -> None:
        """Make a stream that is opened by its first message, or by entering it."""
        super().__init__(state, open_timeout_s)
        self._open = ExitStack()

    def __enter__(self) -> Self:
        self._run(self._receive())
        return self

    def __iter__(self) -> Iterator[Message]:
        return self

    def __next__(self) -> Message:
        """Wait for the next message and return it.

        Raises:
            StopIteration: the stream was closed, or its device deleted.
            StreamEnded: the key was revoked or has expired.
            ServerProblem: the server refused the stream.
            ServerUnreachable: the connection was not made, or lost for too long.
            UnreadableMessage: a message cannot be decoded.
        """
        if not self._received and not self._run(self._receive()):
            raise StopIteration
        return self._take()

    def frames(self) -> Iterator[Frame]:
        """Yield the frames alone."""
        return (message for message in self if isinstance(message, Frame))

    def close(self) -> None:
        """Close the connection, also from another thread; messages not taken are lost."""
        self._closed = True
        self._received.clear()
        self._perform("close")

    def _perform(self, step: Step) -> Any:
        match step:
            case "open":
                connection = blocking_client.connect(self._state.url, **self._options)
                self._socket = self._open.enter_context(connection)
            case "receive":
                return self._connection().recv()
            case "close":
                self._socket = None
                self._open.close()
            case Pause():
                time.sleep(step.seconds)
        return None


class AsyncStream(_SharedStream[asyncio_client.ClientConnection], AsyncRunner):
    """Messages of a device, one after another; an asynchronous context manager.

    Ends when the device is deleted. A connection that is lost is made again; then comes another
    ``Hello``.
    """

    async def __aenter__(self) -> Self:
        await self._run(self._receive())
        return self

    def __aiter__(self) -> AsyncIterator[Message]:
        return self

    async def __anext__(self) -> Message:
        """Wait for the next message and return it.

        Raises:
            StopAsyncIteration: the stream was closed, or its device deleted.
            StreamEnded: the key was revoked or has expired.
            ServerProblem: the server refused the stream.
            ServerUnreachable: the connection was not made, or lost for too long.
            UnreadableMessage: a message cannot be decoded.
        """
        if not self._received and not await self._run(self._receive()):
            raise StopAsyncIteration
        return self._take()

    async def frames(self) -> AsyncIterator[Frame]:
        """Yield the frames alone."""
        async for message in self:
            if isinstance(message, Frame):
                yield message

    async def close(self) -> None:
        """Close the connection; messages not taken are lost."""
        self._closed = True
        self._received.clear()
        await self._perform("close")

    async def _perform(self, step: Step) -> Any:
        match step:
            case "open":
                self._socket = await asyncio_client.connect(self._state.url, **self._options)
            case "receive":
                return await self._connection().recv()
            case "close":
                socket, self._socket = self._socket, None
                if socket is not None:
                    await socket.close()
            case Pause():
                await asyncio.sleep(step.seconds)
        return None
