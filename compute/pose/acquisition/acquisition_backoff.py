"""AcquisitionBackoff: when an unsuccessful acquisition is tried again."""

from typing import Final

MAX_DELAY_FRACTION: Final = 0.1
"""Of the time for which it was looked for in vain: so much later it is found, at most."""
MAX_PAUSE_NS: Final = 250_000_000
"""Pause that is long enough, however long it was looked for in vain."""


class AcquisitionBackoff:
    """Rations the searches of one strobed tool.

    A search costs as much as following twenty exposures or more. A tool that is seen well is found
    by the first, or soon; one whose readings are few and often false takes thirty; one whose
    readings never fit, because of a wrong calibration or another tool's markers, is looked for more
    and more rarely. The pauses grow in proportion to the time for which nothing was found, so that
    waiting adds no more than that share to it, up to LONGEST_NS. All begins anew when there is
    something new to see.
    """

    def __init__(self) -> None:
        """Begin without any search."""
        self.reset()

    def reset(self) -> None:
        """Begin anew: it was found, or what is seen of it is of a new kind."""
        self._first_ns: int | None = None  # of the searches in vain
        self._failed_ns = 0
        self._left = 0
        self._max_readings = -1

    @property
    def is_waiting(self) -> bool:
        """Whether it was looked for in vain, and nothing new was seen since."""
        return self._first_ns is not None

    def count_exposure(self) -> None:
        """Take in that an exposure of its markers went by."""
        self._left -= 1

    def due(self, time_ns: int, readings: int) -> bool:
        """Return whether to look for it now.

        Args:
            time_ns: of the exposure [ns].
            readings: that a search would have; more than any before had are worth one.
        """
        if self._first_ns is None or readings > self._max_readings:
            return True
        pause_ns = time_ns - self._failed_ns
        enough_ns = MAX_DELAY_FRACTION * (self._failed_ns - self._first_ns)
        return pause_ns >= MAX_PAUSE_NS or (self._left <= 0 and pause_ns >= enough_ns)

    def record_failure(self, time_ns: int, readings: int, exposures: int) -> None:
        """Take in that it was looked for in vain.

        Args:
            time_ns: of the newest exposure [ns].
            readings: that the search had.
            exposures: that go by at least until there is something to find it by again.
        """
        if self._first_ns is None or readings > self._max_readings:
            self._first_ns, self._max_readings = time_ns, readings
        self._failed_ns, self._left = time_ns, exposures
