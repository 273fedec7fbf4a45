"""A stream as an iterator that waits."""

import time
from collections import deque
from collections.abc import Iterator
from contextlib import ExitStack
from types import TracebackType
from typing import Self

from websockets.sync.client import ClientConnection, connect

from lumiline.client.messages import Frame, Message
from lumiline.client.stream_state import FAILURES, StreamProgress, StreamState


class Stream(StreamProgress):
    """Messages of a device, one after another; a context manager that closes the connection.

    Ends when the device is deleted. A connection that is lost is made again; then comes another
    ``Hello``.
    """

    def __init__(self, state: StreamState, open_timeout_s: float = 10.0) -> None:
        """Make a stream that is opened by its first message, or by entering it."""
        self._state = state
        self._timeout_s = open_timeout_s
        self._socket: ClientConnection | None = None
        self._open = ExitStack()
        self._waiting: deque[Message] = deque()
        self._closed = False

    def __enter__(self) -> Self:
        self._fill()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def __iter__(self) -> Iterator[Message]:
        return self

    def __next__(self) -> Message:
        """Return the next message.

        Raises:
            StopIteration: the stream was closed, or its device deleted.
            StreamEnded, ServerProblem, ServerUnreachable, UnreadableMessage: see those.
        """
        if not self._fill():
            raise StopIteration
        return self._state.taken(self._waiting.popleft())

    def frames(self) -> Iterator[Frame]:
        """Yield the frames alone."""
        return (message for message in self if isinstance(message, Frame))

    def close(self) -> None:
        """Close the connection; what has been received and not taken is gone."""
        self._closed = True
        self._waiting.clear()
        self._drop()

    def _drop(self) -> None:
        self._socket = None
        self._open.close()

    def _fill(self) -> bool:
        """Wait until there is a message; False: there will be none."""
        while not self._waiting:
            if self._closed:
                return False
            try:
                if self._socket is None:
                    url, options = self._state.url, self._state.options
                    connection = connect(url, open_timeout=self._timeout_s, **options)
                    self._socket = self._open.enter_context(connection)
                self._waiting.extend(self._state.take(self._socket.recv()))
            except FAILURES as error:
                self._drop()
                if self._closed:
                    return False
                wait = self._state.wait_after(error, time.monotonic())
                if wait is None:
                    self._closed = True
                    return False
                time.sleep(wait)
        return True
