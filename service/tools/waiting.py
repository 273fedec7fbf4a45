"""How many requests may wait at once while a device is looked at, or compute in their thread."""

from collections.abc import Iterator
from contextlib import contextmanager
from threading import BoundedSemaphore
from typing import Final

from service.errors import Busy

AT_ONCE: Final = 4
"""Each takes one of the threads that all requests share, for as long as it waits."""
REFINED_AT_ONCE: Final = 2
"""Each takes a core for up to some seconds."""

_slots = BoundedSemaphore(AT_ONCE)
_of_points = BoundedSemaphore(AT_ONCE)
_of_surfaces = BoundedSemaphore(REFINED_AT_ONCE)


@contextmanager
def waiting() -> Iterator[None]:
    """Count a request while it waits; raises Busy when as many as may do already."""
    with _slot(_slots, f"{AT_ONCE} captures and calibrations of tools"):
        yield


@contextmanager
def pointing() -> Iterator[None]:
    """Count a request that waits for a still pointer; likewise.

    They are counted by themselves: who may only read must not keep calibrations from their turn.
    """
    with _slot(_of_points, f"{AT_ONCE} measurements of points"):
        yield


@contextmanager
def refining() -> Iterator[None]:
    """Count a registration by a surface while it is computed; likewise."""
    with _slot(_of_surfaces, f"{REFINED_AT_ONCE} registrations by surfaces"):
        yield


@contextmanager
def _slot(slots: BoundedSemaphore, what: str) -> Iterator[None]:
    if not slots.acquire(blocking=False):
        raise Busy(
            f"{what} are under way, as many as may at once; send this one again when one of them "
            "is done"
        )
    try:
        yield
    finally:
        slots.release()
