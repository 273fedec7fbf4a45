"""One board at its port: requests a scan, waits for it, reports faults."""

import time
from dataclasses import dataclass
from threading import Lock
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hardware.errors import DeviceNotConnected
from hardware.link import LinkPhase
from hardware.serial.port import CloseSignal, Port, PortDisconnected, open_port
from hardware.tcd1304.protocol import RESPONSE_BYTES
from hardware.tcd1304.response import InvalidResponse, ResponseCollector
from hardware.tcd1304.settings import Tcd1304Board, Tcd1304Settings

LATENCY_NS: Final = 20_000_000
"""Longest delay of an answer's first byte: an adapter's latency timer (16 ms), and
the host's own delay."""

RESPONSE_TIMEOUT_S: Final = 1.0
"""Timeout beyond the longest response time of a working board."""


@dataclass(frozen=True, eq=False)
class BoardScan:
    """A scan and the bounds of its exposure time.

    Args:
        counts: raw counts of the converter, uint16, shape (3694,).
        earliest_ns: earliest centre of the exposure, on the clock of time.monotonic_ns().
        latest_ns: latest centre of the exposure.
        bytes_received: bytes received.
    """

    counts: NDArray[np.uint16]
    earliest_ns: int
    latest_ns: int
    bytes_received: int


@dataclass(frozen=True)
class BoardFault:
    """Reason of a missing scan."""

    phase: LinkPhase
    reason: str
    bytes_received: int = 0


class _Closed(Exception):
    """The driver is being closed."""


class BoardLink:
    """The link to a board, connected or not.

    Args:
        board: its name and port.
        settings: of the device.
        closed: ends every wait.
    """

    def __init__(self, board: Tcd1304Board, settings: Tcd1304Settings, closed: CloseSignal) -> None:
        self._board = board
        self._settings = settings
        self._request = settings.request
        self._closed = closed
        self._lock = Lock()
        self._port: Port | None = None
        self._collector = ResponseCollector()
        self._quiet = False

    def connect(self) -> None:
        """Open the port, unless it is open.

        Raises:
            DeviceNotConnected: it cannot be opened.
        """
        with self._lock:
            self._opened()

    @property
    def connected(self) -> bool:
        """Whether the port is open."""
        return self._port is not None

    def ask(self) -> BoardScan | BoardFault | None:
        """Request a scan and wait for it; None: the driver was closed meanwhile."""
        with self._lock:
            try:
                return self._exchange(self._opened())
            except _Closed:
                return None
            except DeviceNotConnected as error:
                return BoardFault("disconnected", error.detail)
            except PortDisconnected as error:
                self._release()
                return BoardFault("disconnected", f"{self._where} was lost: {error}")

    def close(self) -> None:
        """Close the port; waits for ``ask``, which ends when ``closed`` is set."""
        with self._lock:
            self._release()

    @property
    def _where(self) -> str:
        return f'sensor "{self._board.name}" at {self._board.port}'

    def _opened(self) -> Port:
        """Return the port, opened where it is not; raises DeviceNotConnected."""
        if self._port is not None:
            return self._port
        if self._closed.is_set():  # nobody would close it
            raise DeviceNotConnected(f"{self._where}: the driver was closed while it was opened")
        try:
            port = open_port(self._board.port, self._settings.baud_rate, self._closed)
        except DeviceNotConnected as error:
            raise DeviceNotConnected(
                f'sensor "{self._board.name}": {error.detail}; plug the board in, and close other '
                "programs that use the port",
                sensor=self._board.name,
                port=self._board.port,
            ) from error
        self._port, self._quiet = port, False
        return port

    def _release(self) -> None:
        port, self._port = self._port, None
        if port is not None:
            port.close()

    def _exchange(self, port: Port) -> BoardScan | BoardFault:
        self._collector.clear()
        surplus = 0 if self._quiet else self._drain(port)
        # One write: the firmware reads the 12 bytes as one transfer.
        port.write(self._request.encode())
        sent_ns = time.monotonic_ns()
        received = surplus + self._collect(port, sent_ns)
        outcome = self._collector.silence()
        self._quiet = True
        if outcome is None:
            wait_s = self._request.max_wait_ns * 1e-9 + RESPONSE_TIMEOUT_S
            return BoardFault(
                "silent", f"{self._where} did not answer a request within {wait_s:.1f} s", received
            )
        if isinstance(outcome, InvalidResponse):
            self._quiet = False
            return BoardFault("garbled", f"{self._where}: {outcome.detail}", received)
        # Between the request and the first byte, less the time from the exposure's centre to it.
        latest_ns = max(outcome.first_byte_ns - self._request.centre_to_response_ns, sent_ns)
        earliest_ns = max(latest_ns - LATENCY_NS, sent_ns)
        return BoardScan(outcome.counts, earliest_ns, latest_ns, received)

    def _drain(self, port: Port) -> int:
        """Read until silence, or for the time of two responses; return the number of bytes.

        A board that was left in continuous mode is never silent: the request stops it.
        """
        bytes_received, gap_s = 0, self._settings.gap_ms * 1e-3
        end = time.monotonic() + 2.0 * (self._settings.transfer_s + gap_s)
        while time.monotonic() < end:
            data = self._read(port, gap_s)
            if not data:
                break
            bytes_received += len(data)
        return bytes_received

    def _collect(self, port: Port, sent_ns: int) -> int:
        """Feed the collector until the silence after a response; return the number of bytes."""
        wait_ns = self._request.max_wait_ns + round(RESPONSE_TIMEOUT_S * 1e9)
        while not (data := self._read(port, RESPONSE_TIMEOUT_S)):
            if time.monotonic_ns() - sent_ns > wait_ns:
                return 0
        # A board that never stops is cut off: twice an answer is no answer.
        while data and self._collector.pending < 2 * RESPONSE_BYTES:
            self._collector.feed(data, time.monotonic_ns())
            data = self._read(port, self._settings.gap_ms * 1e-3)
        return self._collector.pending

    def _read(self, port: Port, timeout_s: float) -> bytes:
        """Return the first bytes available; empty on timeout."""
        data = port.read(timeout_s)
        if self._closed.is_set():
            raise _Closed
        return data
