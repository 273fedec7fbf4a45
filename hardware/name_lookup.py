"""Looks up host names within a time limit, which the operating system's resolver does not have."""

import socket
from concurrent.futures import Future
from ipaddress import ip_address
from threading import Lock, Thread
from typing import Final

LOOKUP_S: Final = 2.0

_pending: dict[str, "Future[str]"] = {}
_lock = Lock()


def lookup(host: str) -> str:
    """Return the first address of a host; one that is an address is returned as it is.

    Raises:
        TimeoutError: no answer within LOOKUP_S.
        OSError: the name is unknown.
    """
    try:
        return str(ip_address(host))
    except ValueError:
        pass
    # A lookup that hangs keeps its thread: whoever asks again meanwhile waits for the same.
    with _lock:
        future = _pending.get(host)
        if future is None:
            future = _pending[host] = Future()
            Thread(target=_run, args=(host, future), name=f"lookup-{host}", daemon=True).start()
    try:
        return future.result(LOOKUP_S)
    except TimeoutError:
        raise TimeoutError(f"the name {host} was not resolved in {LOOKUP_S:g} s") from None


def _run(host: str, future: "Future[str]") -> None:
    try:
        future.set_result(str(socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)[0][4][0]))
    except Exception as error:  # noqa: BLE001 - the waiter gets it
        future.set_exception(error)
    finally:
        with _lock:
            del _pending[host]
