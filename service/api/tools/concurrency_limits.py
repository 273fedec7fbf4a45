"""How many requests may wait at once while a device is looked at, or compute in their thread."""

from collections.abc import Iterator
from contextlib import contextmanager
from threading import BoundedSemaphore
from typing import Final

from service.problems.errors import Busy

MAX_CONCURRENT: Final = 4
"""Each takes one of the threads that all requests share, for as long as it waits."""
MAX_CONCURRENT_SURFACES: Final = 2
"""Each takes a core for up to some seconds."""

_slots = BoundedSemaphore(MAX_CONCURRENT)
_of_points = BoundedSemaphore(MAX_CONCURRENT)
_of_surfaces = BoundedSemaphore(MAX_CONCURRENT_SURFACES)


@contextmanager
def capture_slot() -> Iterator[None]:
    """Count a request while it waits; raises Busy when as many as may do already."""
    with _slot(_slots, f"{MAX_CONCURRENT} captures and calibrations of tools"):
        yield


@contextmanager
def digitise_slot() -> Iterator[None]:
    """Count a request that waits for a still pointer; likewise.

    They are counted by themselves: who may only read must not keep calibrations from their turn.
    """
    with _slot(_of_points, f"{MAX_CONCURRENT} measurements of points"):
        yield


@contextmanager
def surface_slot() -> Iterator[None]:
    """Count a registration by a surface while it is computed; likewise."""
    with _slot(_of_surfaces, f"{MAX_CONCURRENT_SURFACES} registrations by surfaces"):
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
