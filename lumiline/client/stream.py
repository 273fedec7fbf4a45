"""Stream and AsyncStream: a device's messages as an iterator, over lost connections."""

import asyncio
import time
from collections import deque
from collections.abc import AsyncIterator, Callable, Iterator
from typing import Any, Self

from websockets.asyncio import client as asyncio_client
from websockets.sync import client as blocking_client

from lumiline.client.exchange import finish, result_of
from lumiline.client.messages import Frame, Hello, Message
from lumiline.client.stream_state import CONNECTION_FAILURES, StreamState


class _SharedStream:
    """Connection and messages of a stream; its subclasses are iterators of either kind."""

    _connect: Callable[..., Any]
    _sleep: Callable[[float], Any]

    def __init__(self, state: StreamState, open_timeout_s: float = 10.0) -> None:
        """Make a stream that is opened by its first message, or by entering it."""
        self._state = state
        self._options = {"open_timeout": open_timeout_s, **state.options}
        self._socket: Any = None
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

    async def _receive(self) -> bool:
        """Receive until there is a message; False: there will be none."""
        while not self._received:
            if self._closed:
                return False
            try:
                if self._socket is None:
                    self._socket = await result_of(self._connect(self._state.url, **self._options))
                if self._closed:  # by another thread, while the connection was made
                    await self._disconnect()
                    return False
                socket = self._socket
                if socket is None:
                    raise EOFError("another thread has closed the stream")
                self._received.extend(self._state.decode(await result_of(socket.recv())))
            except CONNECTION_FAILURES as error:
                await self._disconnect()
                if self._closed:
                    return False
                wait_s = self._state.wait_after(error, time.monotonic())
                if wait_s is None:
                    self._closed = True
                    return False
                await result_of(self._sleep(wait_s))
        return True

    def _take(self) -> Message:
        return self._state.take(self._received.popleft())

    async def _disconnect(self) -> None:
        socket, self._socket = self._socket, None
        if socket is not None:
            await result_of(socket.close())

    async def _close(self) -> None:
        self._closed = True
        self._received.clear()
        await self._disconnect()


class Stream(_SharedStream):
    """Messages of a device, one after another; a context manager that closes the connection.

    Ends when the device is deleted. A connection that is lost is made again; then comes another
    ``Hello``.
    """

    _sleep = staticmethod(time.sleep)

    @staticmethod
    def _connect(url: str, **options: Any) -> Any:
        # The library wants a context; its end is ``close``.
        return blocking_client.connect(url, **options).__enter__()

    def __enter__(self) -> Self:
        finish(self._receive())
        return self

    def __exit__(self, *raised: object) -> None:
        self.close()

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
        if not self._received and not finish(self._receive()):
            raise StopIteration
        return self._take()

    def frames(self) -> Iterator[Frame]:
        """Yield the frames alone."""
        return (message for message in self if isinstance(message, Frame))

    def close(self) -> None:
        """Close the connection, also from another thread; messages not taken are lost."""
        finish(self._close())


class AsyncStream(_SharedStream):
    """Messages of a device, one after another; an asynchronous context manager.

    Ends when the device is deleted. A connection that is lost is made again; then comes another
    ``Hello``.
    """

    _connect = staticmethod(asyncio_client.connect)
    _sleep = staticmethod(asyncio.sleep)

    async def __aenter__(self) -> Self:
        await self._receive()
        return self

    async def __aexit__(self, *raised: object) -> None:
        await self.close()

    def __aiter__(self) -> AsyncIterator[Message]:
        return self

    async def __anext__(self) -> Message:
        """Wait for the next message and return it; raises what ``Stream.__next__`` does."""
        if not self._received and not await self._receive():
            raise StopAsyncIteration
        return self._take()

    async def frames(self) -> AsyncIterator[Frame]:
        """Yield the frames alone."""
        async for message in self:
            if isinstance(message, Frame):
                yield message

    async def close(self) -> None:
        """Close the connection; messages not taken are lost."""
        await self._close()
