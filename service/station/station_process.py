"""StationProcess: a station as its gateway has it: process, calls, reader's end of the bus."""

import logging
import os
import pickle
import signal
import socket
import threading
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from multiprocessing.connection import Connection
from queue import SimpleQueue
from threading import Lock, Thread
from typing import Any, Final

from service.problems.errors import NotReady
from service.station.calls import Answer, Call, LogLine, Start
from service.station.shared_ring import Doorbell, RingReader, new_ring
from service.station.station_starter import StationStarter

_log = logging.getLogger(__name__)

RING_BYTES: Final = 1 << 26
"""Of the bus: 0.8 s of four sensors of 2,048 pixels at 5 kHz where their pixels are wanted."""
_END_S: Final = 10.0
"""How long a station has to stop its devices."""


class StationProcess:
    """Starts a station; its calls may be made from any thread.

    Args:
        starter: forks it.
        start: what it is told first.
        lost: called once, from a thread of its own, when it ends without being asked to, with why.
    """

    def __init__(
        self, starter: StationStarter, start: Start, lost: Callable[["StationProcess", str], None]
    ) -> None:
        self._starter = starter
        self._lost = lost
        self._closing = False
        self._lock = Lock()
        self._number = 0
        self._answers: dict[int, Future[Answer]] = {}
        self._why: str | None = None
        memory = new_ring(RING_BYTES)
        self.doorbell = Doorbell()
        self.reader = RingReader(memory, from_begin=True)
        ours, theirs = socket.socketpair()
        self._connection = Connection(ours.detach())
        try:
            with theirs:
                descriptors = (theirs.fileno(), memory, self.doorbell.write_descriptor)
                self.process_id = starter.start(descriptors)
                """Of the operating system."""
        except OSError:
            self.release()
            raise
        finally:
            os.close(memory)
        self._outgoing: SimpleQueue[bytes | None] = SimpleQueue()
        self._sender = Thread(target=self._send, name="station-calls", daemon=True)
        self._receiver = Thread(target=self._receive, name="station-answers", daemon=True)
        self._outgoing.put(pickle.dumps(start))
        self._sender.start()
        self._receiver.start()

    def call(self, method: str, *args: Any, **members: Any) -> Answer:
        """Call a method of the station; return its answer, which may be an error.

        Raises:
            NotReady: the station ends, or has ended.
        """
        return self._asked(method, args, members).result()

    def call_within(self, wait_s: float, method: str) -> Answer:
        """Call a method without arguments; as ``call``.

        Raises:
            NotReady: the station ends, or has ended.
            TimeoutError: there is no answer yet.
        """
        return self._asked(method, (), {}).result(wait_s)

    def _asked(self, method: str, args: tuple[Any, ...], members: dict[str, Any]) -> Future[Answer]:
        """Send a call; return what becomes its answer."""
        future: Future[Answer] = Future()
        with self._lock:
            if self._why is not None:
                raise _not_there(self._why)
            self._number += 1
            call = Call(self._number, method, args, members)
            self._answers[self._number] = future
        self._outgoing.put(pickle.dumps(call))
        return future

    def notify(self, method: str, *args: Any) -> None:
        """Call a method of the station whose answer nobody needs; never waits."""
        self._outgoing.put(pickle.dumps(Call(None, method, args)))

    def close(self) -> None:
        """End the station and wait for it; one that does not end is killed."""
        self._closing = True
        self._outgoing.put(None)
        self._sender.join(_END_S)
        self._receiver.join(_END_S)
        if self._receiver.is_alive():
            _log.error("the station did not end within %g s, and is killed", _END_S)
            with suppress(ProcessLookupError):
                os.kill(self.process_id, signal.SIGKILL)
            self._receiver.join(_END_S)

    def release(self) -> None:
        """Release what its bus is read by; nobody reads it any more."""
        self.reader.close()
        self.doorbell.close()
        self._connection.close()

    def _send(self) -> None:
        try:
            while (message := self._outgoing.get()) is not None:
                self._connection.send_bytes(message)
            with socket.socket(fileno=os.dup(self._connection.fileno())) as end:
                end.shutdown(socket.SHUT_WR)
        except OSError:
            pass  # it has ended: the receiver tells

    def _receive(self) -> None:
        try:
            while True:
                message = self._connection.recv()
                if isinstance(message, LogLine):
                    record = logging.makeLogRecord(message.members)
                    logging.getLogger(record.name).handle(record)
                    continue
                with self._lock:
                    future = self._answers.pop(message.number)
                future.set_result(message)
        except (EOFError, OSError):
            pass
        self._outgoing.put(None)
        code = self._starter.wait(self.process_id, _END_S) or 0
        why = f"signal {-code}" if code < 0 else f"exit status {code}"
        with self._lock:
            self._why = why
            waiting = list(self._answers.values())
            self._answers.clear()
        for future in waiting:
            future.set_exception(_not_there(why))
        if not self._closing:
            threading.Thread(
                target=self._lost, args=(self, why), name="station-lost", daemon=True
            ).start()


def _not_there(why: str) -> NotReady:
    return NotReady(
        f"the process that owns the devices has ended ({why}) and is started again; try again in a "
        "second",
        part="station",
    )
