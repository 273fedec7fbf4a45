"""PipeSender: writes messages to the writer process in order, in a thread of its own.

A stalled writer reads nothing, and no other thread may wait for it.
"""

from collections.abc import Callable
from queue import SimpleQueue
from threading import Thread
from typing import IO

Make = Callable[[], bytes]
Then = Callable[[], None]


class PipeSender:
    """Creates messages and writes them to a pipe, one after the other.

    Args:
        target: the process's input, without a buffer; it is closed at the end.
        name: of the thread.
        failed: called, in the thread, with the error of a message that could not be created;
            nothing is sent after it.
    """

    def __init__(self, target: IO[bytes], name: str, failed: Callable[[Exception], None]) -> None:
        self._target = target
        self._failed = failed
        self._waiting: SimpleQueue[tuple[Make, Then | None] | None] = SimpleQueue()
        Thread(target=self._run, name=name, daemon=True).start()

    def send(self, make: Make, then: Then | None = None) -> None:
        """Queue the message that ``make`` returns; call ``then`` once it is sent. Never waits.

        Both are called in the sender's thread; neither is when the process has ended.
        """
        self._waiting.put((make, then))

    def close(self) -> None:
        """End the thread after the queued messages. Does not wait for it."""
        self._waiting.put(None)

    def _run(self) -> None:
        try:
            while (found := self._waiting.get()) is not None:
                make, then = found
                try:
                    data = make()
                except Exception as error:  # noqa: BLE001 - told to the feed, which ends it
                    self._failed(error)
                    return
                self._write(data)
                if then is not None:
                    then()
        except BrokenPipeError:
            pass  # the process has ended, and its end tells why
        finally:
            self._target.close()

    def _write(self, data: bytes) -> None:
        view = memoryview(data)
        while view:
            view = view[self._target.write(view) or 0 :]
