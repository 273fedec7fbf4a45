"""StaleDataDetector: bit-identical consecutive peaks carry no new measurement."""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

FALSE_ALARM_PROBABILITY: Final = 1e-9
"""That a live image is taken for a frozen one: once in eleven days at a thousand exposures/s."""
_PRIOR_REPEATS, _PRIOR_COMPARED = 0.25, 1.0
"""What is taken for known of a device of which nothing was seen: one reading of four repeats.

So do lines of three pixels whose counts have a deviation of 0.4 before they are rounded; 15 of them
in a row do not. It weighs as much as one reading that was seen.
"""
_MEMORY_READINGS: Final = 10_000.0
"""Readings after which older ones begin to count less: light and gain may change."""
_REST_SIGMAS: Final = 3.0
"""Of the difference of two readings: what moved by more could not have repeated. Deviations hold
the rounding of counts, so that a step of those is less."""


class StaleDataDetector:
    """Tells whether a camera sends an image that it sent before; the tool may be anywhere.

    Noise makes no two exposures equal. How many readings that repeat are too many follows from
    how often single readings of things at rest do, which is learned while they are shown: almost
    never with many bits and much light, now and then where counts are coarse beside the noise.
    """

    def __init__(self) -> None:
        """Begin without any exposure."""
        self._last: dict[int | None, tuple[tuple[int, ...], Array, Array]] = {}
        """By what was lit: how many each sensor had, the readings and their variances."""
        self._same: dict[int | None, int] = {}
        """Readings that repeated in a row, by what was lit."""
        self._run = 0
        """The same in a row whatever was lit: a loop of images repeats all of them."""
        self._equal, self._compared = _PRIOR_REPEATS, _PRIOR_COMPARED

    def add_exposure(self, marker: int | None, position_px: Array, sigma_px: Array) -> None:
        """Take in the peaks of a frame.

        Args:
            marker: strobe slot that was lit; None: all markers.
            position_px: shape (S, K) [px]; NaN where there are fewer than K.
            sigma_px: standard deviations, likewise [px].
        """
        if (marker is None) != (None in self._last):
            # The strobe was switched on or off: what it showed before is no measure.
            self._last.clear()
            self._same.clear()
        there = np.isfinite(position_px)
        if np.count_nonzero(there) == there.size:
            counts = (there.shape[1],) * len(there)
            positions, variances = position_px.flatten(), sigma_px.ravel() ** 2
        else:
            counts = tuple(there.sum(axis=1).tolist())
            positions, variances = position_px[there], sigma_px[there] ** 2
        before = self._last.get(marker)
        self._last[marker] = counts, positions, variances
        if before is None or before[0] != counts:
            self._same[marker] = self._run = 0
            return
        moved = positions - before[1]
        same = moved == 0.0
        repeated = int(np.count_nonzero(same))
        if repeated == len(same):
            # Of an exposure without any peak this says nothing, and changes nothing.
            self._same[marker] = self._same.get(marker, 0) + repeated
            self._run += repeated
            return
        if self._run < self.repeat_limit:
            # They were equal by chance: it goes on.
            self._learn(self._run, self._run)
        self._same[marker] = self._run = 0
        rests = moved**2 <= _REST_SIGMAS**2 * (variances + before[2])
        both = int(np.count_nonzero(same & rests)) if repeated else 0
        self._learn(both, int(np.count_nonzero(rests)))

    def is_stale(self, slots: tuple[int, ...] | None) -> bool:
        """Return whether the exposures of a tool's markers are frozen; None: lit together."""
        repeat_limit = self.repeat_limit
        if self._run >= repeat_limit:
            return True
        return any(self._same.get(slot, 0) >= repeat_limit for slot in slots or ())

    @property
    def repeat_limit(self) -> int:
        """How many readings in a row may not repeat by chance."""
        return math.ceil(math.log(FALSE_ALARM_PROBABILITY) / math.log(self._equal / self._compared))

    def _learn(self, repeated: int, resting: int) -> None:
        """Count readings of what rests, and those of them that repeated."""
        self._equal += repeated
        self._compared += resting
        if self._compared > _MEMORY_READINGS:
            self._equal *= _MEMORY_READINGS / self._compared
            self._compared = _MEMORY_READINGS
