"""Progress: the callback by which long computations report how far they are."""

from collections.abc import Callable

Progress = Callable[[float, str], None]
"""Called with the fraction done, 0 to 1, and the stage. An exception that it raises passes through,
which is how a run is cancelled."""
