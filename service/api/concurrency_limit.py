"""ConcurrencyLimit: a bound on how many requests do the same long work at once."""

from threading import BoundedSemaphore

from service.problems.errors import Busy


class ConcurrencyLimit:
    """Context manager that at most ``count`` threads enter at once; a further one raises Busy.

    Args:
        count: how many.
        message: what the further one is told.
    """

    def __init__(self, count: int, message: str) -> None:
        self._slots = BoundedSemaphore(count)
        self._message = message

    def __enter__(self) -> None:
        if not self._slots.acquire(blocking=False):
            raise Busy(self._message)

    def __exit__(self, *_: object) -> None:
        self._slots.release()
