"""Progress of a running case."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

Listener = Callable[[float, str], None]

_LISTENER: ContextVar[Listener | None] = ContextVar("_LISTENER", default=None)


@contextmanager
def progress_listener(listener: Listener) -> Iterator[None]:
    """Within this, ``tell`` calls the listener; what it raises ends the case."""
    token = _LISTENER.set(listener)
    try:
        yield
    finally:
        _LISTENER.reset(token)


def report_progress(share: float, stage: str) -> None:
    """Tell the share of the case that is done, 0 to 1, and what comes next; nobody may listen."""
    listener = _LISTENER.get()
    if listener is not None:
        listener(share, stage)
