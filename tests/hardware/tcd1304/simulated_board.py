"""Simulated board: answers requests on a socket as the firmware does, including faults."""

import socket
import struct
import time
from collections.abc import Callable
from contextlib import suppress
from threading import Event, Thread
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from hardware.tcd1304.protocol import (
    CLOCK_HZ,
    ELEMENTS,
    FIRST_PIXEL,
    FULL_SCALE,
    KEY,
    PIXELS,
    REQUEST_LAYOUT,
    Request,
)

REQUEST_BYTES: Final = REQUEST_LAYOUT.size
DARK_COUNTS: Final = 3100
"""The converter's count where it is dark."""


def response_counts(
    light: NDArray[np.float64], dark: float = DARK_COUNTS, noise_counts: float = 0.0, seed: int = 0
) -> NDArray[np.uint16]:
    """Return raw converter counts for light in counts.

    Args:
        light: counts by which each pixel goes down, shape (3648,).
        dark: the count without light.
        noise_counts: standard deviation of the noise.
        seed: of the noise.

    Returns:
        Shape (3694,), uint16, dummy elements included.
    """
    counts = np.full(ELEMENTS, dark, dtype=np.float64)
    counts[FIRST_PIXEL : FIRST_PIXEL + PIXELS] -= light
    counts += np.random.default_rng(seed).normal(0.0, noise_counts, ELEMENTS)
    whole: NDArray[np.uint16] = np.clip(np.rint(counts), 0, FULL_SCALE).astype(np.uint16)
    return whole


Respond = Callable[[Request], bytes | None]
"""Returns the response to a request; None: the board is unplugged."""


class SimulatedBoard:
    """A board behind ``socket://127.0.0.1:PORT``; one client at a time, as a serial port.

    Args:
        respond: returns the response's bytes, valid or not.
        realtime: True: waits as long as a board exposes and reads out.
        port: the TCP port; 0: a free one.
    """

    def __init__(self, respond: Respond, *, realtime: bool = False, port: int = 0) -> None:
        self.respond = respond
        self.requests: list[Request] = []
        self._realtime = realtime
        self._closed = Event()
        self._client: socket.socket | None = None
        self._server = socket.create_server(("127.0.0.1", port))
        self.port: int = self._server.getsockname()[1]
        self._thread = Thread(target=self._serve, name="tcd1304-board", daemon=True)
        self._thread.start()

    @property
    def url(self) -> str:
        """URL of the board."""
        return f"socket://127.0.0.1:{self.port}"

    def send(self, data: bytes) -> None:
        """Send unsolicited bytes."""
        client = self._client
        if client is not None:
            client.sendall(data)

    def unplug(self) -> None:
        """Break the connection, as by unplugging the cable; it can be reconnected."""
        client = self._client
        if client is not None:
            client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            with suppress(OSError):
                client.shutdown(socket.SHUT_RD)  # wakes the thread that receives, and ends it

    def close(self) -> None:
        """Switch the board off: connections are refused from now on."""
        self._closed.set()
        # Closing alone does not wake a thread that waits in accept or recv.
        for one in (self._server, self._client):
            if one is not None:
                with suppress(OSError):
                    one.shutdown(socket.SHUT_RDWR)
                one.close()
        self._thread.join(240.0)

    def _serve(self) -> None:
        while not self._closed.is_set():
            try:
                client, _ = self._server.accept()
            except OSError:
                return
            self._client = client
            with client:
                try:
                    self._talk(client)
                except OSError:
                    continue

    def _talk(self, client: socket.socket) -> None:
        waiting = b""
        while data := client.recv(4096):
            waiting += data
            # The key is searched as in the firmware, which so outlives bytes of other programs.
            while (start := waiting.find(KEY)) >= 0 and len(waiting) - start >= REQUEST_BYTES:
                request_bytes = waiting[start : start + REQUEST_BYTES]
                waiting = waiting[start + REQUEST_BYTES :]
                try:
                    request = decode_request(request_bytes)
                except InvalidParameter:
                    continue
                self.requests.append(request)
                if self._realtime:
                    time.sleep(request.centre_to_response_ns * 1e-9)
                answer = self.respond(request)
                if answer is None:
                    return
                client.sendall(answer)


def decode_request(data: bytes, clock_hz: int = CLOCK_HZ) -> Request:
    """Decode a request of 12 bytes, as a board does.

    Raises:
        InvalidParameter: these bytes are no request, or one that the board would not do.
    """
    if len(data) != REQUEST_BYTES or not data.startswith(KEY):
        raise InvalidParameter(
            f"a request has {REQUEST_BYTES} bytes and begins with {KEY!r}; these are {data!r}"
        )
    _, sh_clocks, icg_clocks, mode, averages = REQUEST_LAYOUT.unpack(data)
    return Request(sh_clocks, icg_clocks, averages, bool(mode), clock_hz)
