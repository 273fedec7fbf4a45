"""Runs a benchmark's peer in a separate process."""

import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def running_peer(module: str, *arguments: str) -> Iterator[str]:
    """Run a module with a listening socket and yield the URL; ends it afterwards.

    Args:
        module: gets the socket's descriptor as its first argument: see ``inherited_listener``.
        arguments: that it gets behind it.
    """
    listener = socket.socket()
    listener.bind(("127.0.0.1", 0))
    listener.listen()
    port = listener.getsockname()[1]
    process = subprocess.Popen(  # noqa: S603 - our own modules
        [sys.executable, "-m", module, str(listener.fileno()), *arguments],
        pass_fds=[listener.fileno()],
    )
    listener.close()
    try:
        yield f"ws://127.0.0.1:{port}/"
    finally:
        process.terminate()
        process.wait()


def inherited_listener() -> socket.socket:
    """Return the listening socket that ``running_peer`` handed to this process."""
    return socket.socket(fileno=int(sys.argv[1]))
