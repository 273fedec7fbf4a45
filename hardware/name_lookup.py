"""Looks up host names within a time limit, which the operating system's resolver does not have."""

import socket
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from contextlib import suppress
from ipaddress import ip_address
from threading import Lock, Thread
from typing import Final, TypeVar

LOOKUP_S: Final = 2.0

_pending: dict[str, "Future[tuple[str, ...]]"] = {}
_T = TypeVar("_T")
_lock = Lock()


def lookup(host: str) -> tuple[str, ...]:
    """Return the addresses of a host, the preferred first; of one that is an address, that one.

    A peer may listen at some of them only: ``localhost`` is ``::1`` and ``127.0.0.1``.

    Raises:
        TimeoutError: no answer within LOOKUP_S.
        OSError: the name is unknown.
    """
    try:
        return (str(ip_address(host)),)
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


def connect_to_any(addresses: Sequence[str], connect: Callable[[str], _T]) -> _T:
    """Return what ``connect`` makes of the first address that it can connect to.

    Raises:
        OSError: of the last address, where none could be connected to.
    """
    for address in addresses[:-1]:
        with suppress(OSError):
            return connect(address)
    return connect(addresses[-1])


def _run(host: str, future: "Future[tuple[str, ...]]") -> None:
    try:
        found = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)
        future.set_result(tuple(dict.fromkeys(str(one[4][0]) for one in found)))
    except Exception as error:  # noqa: BLE001 - the waiter gets it
        future.set_exception(error)
    finally:
        with _lock:
            del _pending[host]
