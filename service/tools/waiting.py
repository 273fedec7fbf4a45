"""How many requests may wait at once while a device is looked at."""

from collections.abc import Iterator
from contextlib import contextmanager
from threading import BoundedSemaphore
from typing import Final

from service.errors import Busy

AT_ONCE: Final = 4
"""Each takes one of the threads that all requests share, for as long as it waits."""

_slots = BoundedSemaphore(AT_ONCE)


@contextmanager
def waiting() -> Iterator[None]:
    """Count a request while it waits; raises Busy when as many as may do already."""
    if not _slots.acquire(blocking=False):
        raise Busy(
            f"{AT_ONCE} captures and calibrations of tools are under way, as many as may at once; "
            "send this one again when one of them is done"
        )
    try:
        yield
    finally:
        _slots.release()
