"""Progress: the callback by which long computations report how far they are."""

from collections.abc import Callable

Progress = Callable[[float, str], None]
"""Called with the fraction done, 0 to 1, and the stage. An exception that it raises passes through,
which is how a run is cancelled."""


def no_progress(_fraction: float, _stage: str) -> None:
    """Report nothing."""


def partial_progress(progress: Progress, first: float, last: float) -> Progress:
    """Return the callback of a part of a computation.

    Args:
        progress: the callback of the whole.
        first: fraction of the whole at which the part begins.
        last: fraction at which it ends.
    """
    return lambda fraction, stage: progress(first + (last - first) * fraction, stage)
