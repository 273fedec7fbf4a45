"""Progress reports of long computations: the callback's type and shares of a whole."""

from collections.abc import Callable

Progress = Callable[[float, str], None]
"""Called with the fraction done, 0 to 1, and the stage. What it raises passes through, which is
how a run is cancelled."""


def report_progress(progress: Progress | None, fraction: float, stage: str) -> None:
    """Call ``progress``, if there is one.

    Args:
        progress: the callback; None: nobody listens.
        fraction: of the computation that is done, 0 to 1.
        stage: what is done next, for people.
    """
    if progress is not None:
        progress(fraction, stage)


def partial_progress(progress: Progress | None, first: float, last: float) -> Progress | None:
    """Return the callback of a part of a computation.

    Args:
        progress: the whole's callback; None: nobody listens.
        first: fraction of the whole at the part's start.
        last: fraction of the whole at its end.
    """
    if progress is None:
        return None
    return lambda fraction, stage: progress(first + (last - first) * fraction, stage)
