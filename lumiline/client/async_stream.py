"""A stream as an asynchronous iterator."""

import asyncio
from collections import deque
from collections.abc import AsyncIterator
from types import TracebackType
from typing import Self

from websockets.asyncio.client import ClientConnection, connect

from lumiline.client.messages import Frame, Message
from lumiline.client.stream_state import FAILURES, StreamProgress, StreamState


class AsyncStream(StreamProgress):
    """Messages of a device, one after another; an asynchronous context manager.

    Ends when the device is deleted. A connection that is lost is made again; then comes another
    ``Hello``.
    """

    def __init__(self, state: StreamState, open_timeout_s: float = 10.0) -> None:
        """Make a stream that is opened by its first message, or by entering it."""
        self._state = state
        self._timeout_s = open_timeout_s
        self._socket: ClientConnection | None = None
        self._waiting: deque[Message] = deque()
        self._closed = False

    async def __aenter__(self) -> Self:
        await self._fill()
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        await self.close()

    def __aiter__(self) -> AsyncIterator[Message]:
        return self

    async def __anext__(self) -> Message:
        """Return the next message.

        Raises:
            StopAsyncIteration: the stream was closed, or its device deleted.
            StreamEnded, ServerProblem, ServerUnreachable, UnreadableMessage: see those.
        """
        if not await self._fill():
            raise StopAsyncIteration
        return self._state.taken(self._waiting.popleft())

    async def frames(self) -> AsyncIterator[Frame]:
        """Yield the frames alone."""
        async for message in self:
            if isinstance(message, Frame):
                yield message

    async def close(self) -> None:
        """Close the connection; what has been received and not taken is gone."""
        self._closed = True
        self._waiting.clear()
        await self._drop()

    async def _drop(self) -> None:
        socket, self._socket = self._socket, None
        if socket is not None:
            await socket.close()

    async def _fill(self) -> bool:
        """Wait until there is a message; False: there will be none."""
        clock = asyncio.get_running_loop().time
        while not self._waiting:
            if self._closed:
                return False
            try:
                if self._socket is None:
                    self._socket = await connect(
                        self._state.url, open_timeout=self._timeout_s, **self._state.options
                    )
                self._waiting.extend(self._state.take(await self._socket.recv()))
            except FAILURES as error:
                await self._drop()
                if self._closed:
                    return False
                wait = self._state.wait_after(error, clock())
                if wait is None:
                    self._closed = True
                    return False
                await asyncio.sleep(wait)
        return True
