"""ClockBound: how far a station's monotonic clock is ahead of this machine's, at most.

"The beam is enabled" has a deadline by the clock of the station's machine. Here it has to end no
later, whatever the network did with the message: so it is taken as early as it can be. A question
to the station that left at t0 and that it answered at its time t1 shows that its clock is ahead by
at most t1 - t0, since the question cannot have come before it left. The smallest such bound of the
last questions counts; as clocks drift, each grows with its age. What it errs by is at most the time
that the fastest of these questions took to the station.
"""

import math
from collections import deque
from typing import Final

DRIFT: Final = 1e-3
"""How much faster one clock may run than another: twice what clocks are slewed by at most."""
KEPT: Final = 32
"""Questions that count."""


class ClockBound:
    """Upper bound of the difference of two monotonic clocks."""

    def __init__(self) -> None:
        self._bounds: deque[tuple[float, float]] = deque(maxlen=KEPT)

    def clear(self) -> None:
        """Forget all: it is another clock from now on."""
        self._bounds.clear()

    def add(self, asked_s: float, station_s: float) -> None:
        """Take a question: when it was asked here, and answered there [s]."""
        self._bounds.append((asked_s, station_s - asked_s))

    def ahead_s(self, now_s: float) -> float:
        """Return how far the other clock is ahead at most [s]; infinite: nobody knows."""
        return min(
            (bound + DRIFT * (now_s - asked_s) for asked_s, bound in tuple(self._bounds)),
            default=math.inf,
        )

    def local_s(self, station_s: float, now_s: float) -> float:
        """Return the earliest time here that a time of the station's clock can be [s]."""
        local_s = station_s - self.ahead_s(now_s)
        return local_s - DRIFT * max(0.0, local_s - now_s)
