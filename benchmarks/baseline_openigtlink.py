"""Baseline of the OpenIGTLink benchmark: a socket that sends messages of the same size."""

import contextlib
import socket
import time
from typing import Final

from benchmarks.peer_process import inherited_listener

RATE_HZ: Final = 200.0
TOOLS: Final = 10


def _serve(listener: socket.socket) -> None:
    """Send messages encoded by pyigtl to each client, each at its due time."""
    import numpy as np
    import pyigtl

    while True:
        link, _ = listener.accept()
        link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        begin, number = time.monotonic(), 0
        with contextlib.suppress(OSError), link:
            while True:
                wait = begin + number / RATE_HZ - time.monotonic()
                if wait > 0.0:
                    time.sleep(wait)
                exposure_s = time.time()
                matrix = np.eye(4)
                matrix[0, 3] = number
                link.sendall(
                    b"".join(
                        pyigtl.TransformMessage(matrix, exposure_s, f"tool-{tool}ToTracker").pack()
                        for tool in range(TOOLS)
                    )
                )
                number += 1


if __name__ == "__main__":
    _serve(inherited_listener())
