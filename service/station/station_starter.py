"""StationStarter: forks stations from a process that has loaded what they need.

To load the numerical libraries takes a second and more, to fork a process that has them some
hundredths of one: a station that is lost is back before the next beat.
"""

import logging
import os
import select
import signal
import socket
import struct
import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress
from multiprocessing.connection import Connection
from threading import Lock
from typing import Final

_log = logging.getLogger(__name__)

_STARTED: Final = struct.Struct("<q")
_ENDED: Final = struct.Struct("<qi")  # process, exit code or negative signal
PRELOADED: Final = (
    "compute.pose.filtering.native.strobed_step",
    "compute.pose.tool_tracking.tool_tracker",
    "compute.tracking.tracker",
    "compute.tracking.native.kernels",
    "hardware.serial.driver",
    "hardware.simulated.profile_driver",
    "service.api.devices.profiles",
    "service.station.process",
    "warp",
)
"""Modules that a station loads sooner or later."""


class StationStarter:
    """Has a process that forks stations; used by one thread at a time.

    It has one thread, no graphics card and no device: all that begins in the fork.
    """

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._control: socket.socket | None = None
        self._lock = Lock()

    def launch(self) -> None:
        """Begin to load what stations need, if that was not begun; does not wait for it."""
        with self._lock:
            if self._control is None:
                self._launch()

    def start(self, descriptors: Sequence[int]) -> int:
        """Fork a station; return its process id.

        Args:
            descriptors: of its calls, its ring's memory, and its doorbell; stay the caller's.

        Raises:
            OSError: no process can be started.
        """
        with self._lock:
            for attempt in range(2):
                try:
                    return self._start(descriptors)
                except (BrokenPipeError, ConnectionError, EOFError) as error:
                    # It was killed: one more, with a new one.
                    self._forget()
                    if attempt:
                        raise OSError("what forks stations has ended twice") from error
        raise AssertionError

    def wait(self, process_id: int, timeout_s: float) -> int | None:
        """Return the exit code of a station, or minus the signal; None: it still runs.

        A station whose starter has ended has no exit code: 0, once it is gone.
        """
        with self._lock:
            control = self._control
            if control is None:
                return 0
            with suppress(OSError):
                while select.select([control], [], [], timeout_s)[0]:
                    message = control.recv(_ENDED.size)
                    if not message:
                        self._forget()
                        return 0
                    ended, code = _ENDED.unpack(message)
                    if ended == process_id:
                        return int(code)
            return None

    def close(self) -> None:
        """End the process; its stations go on."""
        with self._lock:
            self._forget()

    def _start(self, descriptors: Sequence[int]) -> int:
        if self._control is None:
            self._launch()
        assert self._control is not None
        socket.send_fds(self._control, [b"+"], list(descriptors))
        while True:
            message = self._control.recv(_ENDED.size)
            if not message:
                raise EOFError
            if len(message) == _STARTED.size:
                return int(_STARTED.unpack(message)[0])

    def _launch(self) -> None:
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            self._process = subprocess.Popen(  # noqa: S603 - our own module
                [sys.executable, "-m", "service.station", str(theirs.fileno())],
                stdin=subprocess.DEVNULL,
                pass_fds=[theirs.fileno()],
                # A library with threads of its own could not be forked.
                env=os.environ | {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"},
            )
        self._control = ours

    def _forget(self) -> None:
        if self._control is not None:
            self._control.close()
            self._control = None
        if self._process is not None:
            # It has nothing to bring to an end, and may still be loading.
            self._process.kill()
            self._process.wait()
            self._process = None


def main() -> None:
    """Be that process: fork a station for each message, tell of each that ends."""
    _ignore_signals()
    control = socket.socket(fileno=int(sys.argv[1]))
    for name in PRELOADED:
        __import__(name)
    woken, wake = os.pipe()
    os.set_blocking(woken, False)
    os.set_blocking(wake, False)
    signal.signal(signal.SIGCHLD, lambda *_: None)
    signal.set_wakeup_fd(wake)
    while True:
        ready, _, _ = select.select([control.fileno(), woken], [], [])
        if woken in ready:
            os.read(woken, 4096)
            _tell_ended(control)
        if control.fileno() in ready:
            message, descriptors, _, _ = socket.recv_fds(control, 1, 3)
            if not message:
                return
            process_id = os.fork()
            if process_id == 0:
                signal.set_wakeup_fd(-1)
                signal.signal(signal.SIGCHLD, signal.SIG_DFL)
                for descriptor in (woken, wake, control.detach()):
                    os.close(descriptor)
                _be_station(*descriptors)
            for descriptor in descriptors:
                os.close(descriptor)
            control.send(_STARTED.pack(process_id))


def _ignore_signals() -> None:
    """Go on: Ctrl-C, and a service manager's signal, go to all processes; the gateway decides."""
    for name in ("SIGINT", "SIGTERM", "SIGHUP"):
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), signal.SIG_IGN)


def _be_station(connection: int, memory: int, doorbell: int) -> None:
    from service.station.process import run
    from service.station.shared_ring import RingWriter

    code = 1
    try:
        run(Connection(connection), RingWriter(memory), doorbell)
        code = 0
    except BaseException:  # noqa: BLE001 - the process ends with it
        _log.exception("the station has failed")
    finally:
        # Threads of drivers that hang must not keep the process.
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def _tell_ended(control: socket.socket) -> None:
    while True:
        try:
            process_id, status = os.waitpid(-1, os.WNOHANG)
        except ChildProcessError:
            return
        if process_id == 0:
            return
        control.send(_ENDED.pack(process_id, os.waitstatus_to_exitcode(status)))
