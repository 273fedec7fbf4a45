"""SearchPause: when a tool that was looked for in vain is looked for again."""

from typing import Final

FULL_RATE: Final = 3
"""Searches in vain after which the pauses grow: exposures of a tool that moved oddly soon go by."""
LONGEST_NS: Final = 250_000_000
"""Pause that is long enough, however often it was looked for in vain."""


class SearchPause:
    """Rations the searches of one strobed tool.

    A search costs as much as following twenty exposures or more. A tool that is there is found by
    the first, or soon; one whose readings never fit, because of a wrong calibration or another
    tool's markers, is looked for more and more rarely: after each search in vain twice as many
    exposures go by, or LONGEST_NS. All begins anew when there is something new to see.
    """

    def __init__(self) -> None:
        """Begin without any search."""
        self.forget()

    def forget(self) -> None:
        """Begin anew: it was found, or what is seen of it is of a new kind."""
        self._failures = 0
        self._left = 0
        self._failed_ns = 0
        self._most_readings = -1

    @property
    def waits(self) -> bool:
        """Whether it was looked for in vain, and nothing new was seen since."""
        return self._failures > 0

    def passed(self) -> None:
        """Take in that an exposure of its markers went by."""
        self._left -= 1

    def due(self, time_ns: int, readings: int) -> bool:
        """Return whether to look for it now.

        Args:
            time_ns: of the exposure [ns].
            readings: that a search would have; more than any before had are worth one.
        """
        if readings > self._most_readings:
            return True
        return self._left <= 0 or time_ns - self._failed_ns >= LONGEST_NS

    def failed(self, time_ns: int, readings: int, exposures: int) -> None:
        """Take in that it was looked for in vain.

        Args:
            time_ns: of the newest exposure [ns].
            readings: that the search had.
            exposures: that go by at least until there is something to find it by again.
        """
        if readings > self._most_readings:
            self._failures, self._most_readings = 0, readings
        self._failures += 1
        self._left = exposures << min(max(0, self._failures - FULL_RATE), 16)
        self._failed_ns = time_ns
