"""What a camera numbers and times, made to go on: over 16-bit numbers, restarts and reconnects."""

from typing import Final

_LAST_16_BIT: Final = 65535
_NEAR: Final = 32768


class FrameCounter:
    """Frame numbers of a camera, as exposures since the driver was opened.

    GigE Vision's 16-bit numbers go from 65535 to 1; extended ones have 64 bits. A number that
    goes back otherwise is that of a camera which began anew.
    """

    def __init__(self) -> None:
        self.lost = 0
        """Numbers that were left out."""
        self.restarts = 0
        """How often the numbers began anew; how many exposures were lost then, nobody knows."""
        self._last: int | None = None
        self._count = -1

    def next(self, number: int) -> int:
        """Return the count of the frame with this number, larger than the last one."""
        step = 1 if self._last is None else _step(self._last, number)
        if step is None:
            self.restarts += 1
            step = 1
        self._last = number
        self._count += step
        self.lost += step - 1
        return self._count

    def restart(self) -> None:
        """Take the next number as it is: the camera was lost meanwhile."""
        self._last = None
        self.restarts += 1


def _step(last: int, number: int) -> int | None:
    """Return how many exposures later; None: the camera began anew."""
    if number > last:
        return number - last
    wrapped = number + _LAST_16_BIT - last
    if last <= _LAST_16_BIT and 0 < wrapped < _NEAR and number > 0:
        return wrapped
    return None
