"""Exposure history: frozen images (StaleDataDetector) and the strobe period (StrobeCycle)."""

import math
from collections import deque
from typing import Final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

FALSE_ALARM_PROBABILITY: Final = 1e-9
"""Probability that a live image is taken for frozen: once in eleven days at 1,000 exposures/s."""
_PRIOR_REPEATS, _PRIOR_COMPARED = 0.25, 1.0
"""Prior of an unknown device: one reading of four repeats.

Lines of three pixels whose counts have a standard deviation of 0.4 before rounding repeat as often;
15 of them in a row do not. The prior weighs as much as one observed reading.
"""
_MEMORY_READINGS: Final = 10_000.0
"""Number of readings after which older ones lose weight: light and gain may change."""
_REST_SIGMAS: Final = 3.0
"""A marker that moved by more standard deviations of the difference of two readings is not at rest:
its reading could not repeat. The sigmas include the rounding of counts, so one count is less."""


class StaleDataDetector:
    """Detects a camera that repeats an image: its peaks are bit-identical.

    Noise makes live exposures differ. How many repeated readings are too many depends on how often
    single readings of markers at rest repeat, which is learned while they are visible: almost never
    with many bits and much light, now and then where counts are coarse compared with the noise.
    """

    def __init__(self) -> None:
        """Start without any exposure."""
        self._last: dict[int | None, tuple[tuple[int, ...], Array, Array]] = {}
        """By slot: number of peaks of each sensor, positions and variances of the last exposure."""
        self._same: dict[int | None, int] = {}
        """By slot: number of consecutive repeated readings, where the last ones repeated."""
        self._run = 0
        """The same over all slots: a loop of images repeats every slot."""
        self._equal, self._compared = _PRIOR_REPEATS, _PRIOR_COMPARED

    def add_exposure(self, marker: int | None, position_px: Array, sigma_px: Array) -> None:
        """Add the peaks of an exposure.

        Args:
            marker: strobe slot that was lit; None: all markers.
            position_px: peak positions of S sensors, shape (S, K) [px]; NaN for missing peaks.
            sigma_px: their standard deviations, shape (S, K) [px].
        """
        if (marker is None) != (None in self._last):
            # The strobe was switched on or off: earlier exposures are not comparable.
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
            self._same.pop(marker, None)
            self._run = 0
            return
        moved = positions - before[1]
        same = moved == 0.0
        repeated = int(np.count_nonzero(same))
        if repeated == len(same):
            # An exposure without any peak changes nothing here.
            self._same[marker] = self._same.get(marker, 0) + repeated
            self._run += repeated
            return
        if self._run < self.repeat_limit:
            # They were equal by chance.
            self._learn(self._run, self._run)
        self._same.pop(marker, None)
        self._run = 0
        rests = moved**2 <= _REST_SIGMAS**2 * (variances + before[2])
        both = int(np.count_nonzero(same & rests)) if repeated else 0
        self._learn(both, int(np.count_nonzero(rests)))

    def is_stale(self, slots: tuple[int, ...] | None) -> bool:
        """Return whether the exposures of a tool's slots are frozen; None: markers lit together."""
        if not self._same:
            return False
        repeat_limit = self.repeat_limit
        if self._run >= repeat_limit:
            return True
        return any(self._same.get(slot, 0) >= repeat_limit for slot in slots or ())

    @property
    def repeat_limit(self) -> int:
        """Number of consecutive repeated readings that cannot be chance."""
        return math.ceil(math.log(FALSE_ALARM_PROBABILITY) / math.log(self._equal / self._compared))

    def _learn(self, repeated: int, resting: int) -> None:
        """Count readings of markers at rest, and how many of them repeated."""
        self._equal += repeated
        self._compared += resting
        if self._compared > _MEMORY_READINGS:
            self._equal *= _MEMORY_READINGS / self._compared
            self._compared = _MEMORY_READINGS


INTERVALS_KEPT: Final = 3
"""Number of intervals kept per slot; the shortest counts, as lost frames lengthen the others."""
MAX_CYCLE_NS: Final = 1_000_000_000
"""Longest strobe period; a longer interval is an interruption."""


class StrobeCycle:
    """Period of each strobe slot, learned from the times of its exposures."""

    def __init__(self) -> None:
        """Start without any exposure."""
        self._last: dict[int, int] = {}
        self._between: dict[int, deque[int]] = {}

    def add_exposure(self, slot: int | None, time_ns: int) -> None:
        """Add an exposure.

        Args:
            slot: strobe slot that was lit; None: all markers, from which nothing is learned.
            time_ns: time of the exposure [ns].
        """
        if slot is None:
            return
        last = self._last.get(slot)
        self._last[slot] = time_ns
        if last is not None and time_ns - last <= MAX_CYCLE_NS:
            self._between.setdefault(slot, deque(maxlen=INTERVALS_KEPT)).append(time_ns - last)

    def duration_ns(self, slots: tuple[int, ...] | None) -> int:
        """Return the longest period of the slots [ns]; 0: unknown, or markers lit together."""
        periods = [min(self._between[slot]) for slot in slots or () if slot in self._between]
        return max(periods, default=0)
