"""StrobedPoseCollector: poses of a moved target whose markers are lit one after the other."""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter

Array = NDArray[np.float64]

MAX_GAP_CYCLES: Final = 1.5
"""Longest time between two readings of a marker that are interpolated, in strobe cycles."""
MIN_MOTION: Final = 0.02
"""Share of the pixels by which a reading must have changed since the pose before, on the mean of
the markers and sensors: nearly equal poses say nothing new."""
MIN_SENSORS: Final = 3
"""Sensors that must read each marker of a pose."""
KEPT_CYCLES: Final = 8
"""Strobe cycles that are kept of exposures already used: later ones are interpolated from them."""
MAX_KEPT: Final = 4096
"""Largest number of exposures that are kept while the first marker is not lit."""


@dataclass(frozen=True, eq=False)
class StrobedReadings:
    """Readings of F exposures, each of one lit marker.

    Args:
        time_s: middle of the exposures, increasing, shape (F,) [s].
        marker: number of the lit marker, shape (F,); negative: all were lit.
        readings_px: shape (F, S) [px]; NaN where not seen.
        sigma_px: standard deviations, shape (F, S) [px].
    """

    time_s: Array
    marker: NDArray[np.intp]
    readings_px: Array
    sigma_px: Array

    def select(self, rows: NDArray[np.bool_]) -> "StrobedReadings":
        """Return some of the exposures, by a mask (F,)."""
        return StrobedReadings(*(getattr(self, one.name)[rows] for one in fields(self)))

    def followed_by(self, later: "StrobedReadings") -> "StrobedReadings":
        """Return these exposures and later ones."""
        return StrobedReadings(
            *(
                np.concatenate([getattr(self, one.name), getattr(later, one.name)])
                for one in fields(self)
            )
        )


@dataclass
class PoseCounts:
    """Exposures of a target's first marker, counted by whether and why not they gave a pose.

    Args:
        taken: poses taken.
        still: the target had hardly moved since the pose before.
        too_few_sensors: a marker was read by fewer than MIN_SENSORS sensors.
        not_lit: another marker was not lit soon enough before and after: exposures were lost.
    """

    taken: int = 0
    still: int = 0
    too_few_sensors: int = 0
    not_lit: int = 0

    @property
    def all(self) -> int:
        """All exposures of the first marker."""
        return self.taken + self.still + self.too_few_sensors + self.not_lit


@dataclass
class StrobedPoseCollector:
    """Collects the readings of a target's K markers at the same instants, as exposures come.

    A pose is taken at exposures of the first marker. The readings of the others are interpolated
    linearly between their exposures before and after; what moves at 2 m/s^2 in a cycle of 4 ms is
    then off by 0.004 mm. Poses that hardly differ from the one before are left out.

    Args:
        markers: numbers of the target's markers, in the target's order, shape (K,).
        pixels: of the S sensors.

    Raises:
        InvalidParameter: a marker is given twice.
    """

    markers: Sequence[int]
    pixels: Sequence[int]
    counts: PoseCounts = field(default_factory=PoseCounts)
    _poses: list[tuple[Array, Array]] = field(default_factory=list)
    _lit: set[int] = field(default_factory=set)
    _kept: StrobedReadings | None = None
    _decided_s: float = -np.inf
    """Exposures of the first marker up to here have become poses, or not."""

    def __post_init__(self) -> None:
        if len(set(self.markers)) != len(self.markers):
            raise InvalidParameter(
                f"markers {list(self.markers)} has one twice; each has its own number"
            )

    def restore(self, readings_px: Array, sigma_px: Array) -> None:
        """Put poses that were taken earlier before all others.

        Args:
            readings_px: shape (B, K, S) [px]; NaN where not seen.
            sigma_px: their standard deviations, shape (B, K, S) [px].
        """
        self._poses = [*zip(readings_px, sigma_px, strict=True), *self._poses]

    def __len__(self) -> int:
        """Return the number of poses."""
        return len(self._poses)

    def poses(self) -> tuple[Array, Array]:
        """Return readings and standard deviations, shape (B, K, S) [px]; NaN where not seen."""
        shape = (len(self._poses), len(self.markers), len(self.pixels))
        readings, sigma = (
            np.array([pose[part] for pose in self._poses]).reshape(shape) for part in (0, 1)
        )
        return readings, sigma

    @property
    def all_lit(self) -> bool:
        """Whether each of the target's markers was lit alone."""
        return self._lit.issuperset(self.markers)

    def check_lit(self) -> None:
        """Check that each marker was lit.

        Raises:
            InvalidParameter: a marker was never lit alone.
        """
        for number in self.markers:
            if number not in self._lit:
                strobed = sorted(one for one in self._lit if one >= 0)
                what = (
                    f"markers {strobed} are" if strobed else "all markers are lit together: none is"
                )
                raise InvalidParameter(
                    f"marker {number} was never lit alone; {what} strobed", marker=int(number)
                )

    def add(self, exposures: StrobedReadings) -> None:
        """Add exposures that follow those before; where time goes back, the device began anew."""
        if len(exposures.time_s) == 0:
            return
        self._lit.update(exposures.marker.tolist())
        kept = self._kept
        if kept is not None and exposures.time_s[0] <= kept.time_s[-1]:
            kept, self._decided_s = None, -np.inf
        kept = exposures if kept is None else kept.followed_by(exposures)
        lit = [np.flatnonzero(kept.marker == one) for one in self.markers]
        time = kept.time_s[lit[0]]
        cycle = float(np.median(np.diff(time))) if len(time) > 1 else 0.0
        # Up to here nothing that is still to come can be interpolated with.
        until = max(
            min(kept.time_s[rows[-1]] if len(rows) else -np.inf for rows in lit[1:]),
            kept.time_s[-1] - MAX_GAP_CYCLES * cycle,
        )
        due = (time > self._decided_s) & (time <= until)
        if len(time) > 1 and due.any():
            self._take(*_interpolate(kept, lit, time[due], cycle))
            self._decided_s = float(time[due][-1])
        still_used = np.arange(len(kept.time_s)) >= len(kept.time_s) - MAX_KEPT
        if len(time) > 1:
            still_used = kept.time_s >= self._decided_s - KEPT_CYCLES * cycle
        self._kept = kept.select(still_used)

    def _take(self, readings: Array, sigma: Array, lit: NDArray[np.bool_]) -> None:
        """Take poses that each differ from the one before, and count the others."""
        pixels = np.asarray(self.pixels, dtype=np.float64)
        seen = (np.isfinite(readings).sum(axis=2) >= MIN_SENSORS).all(axis=1)
        for index in range(len(readings)):
            if not lit[index]:
                self.counts.not_lit += 1
            elif not seen[index]:
                self.counts.too_few_sensors += 1
            elif self._poses and not _has_moved(readings[index], self._poses[-1][0], pixels):
                self.counts.still += 1
            else:
                self.counts.taken += 1
                self._poses.append((readings[index], sigma[index]))


def _interpolate(
    exposures: StrobedReadings, lit: Sequence[NDArray[np.intp]], time_s: Array, cycle_s: float
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Return readings, sigmas and whether all markers were lit, at exposures of the first."""
    first = lit[0][np.searchsorted(exposures.time_s[lit[0]], time_s)]
    shape = (len(time_s), len(lit), exposures.readings_px.shape[1])
    readings, sigma = np.full(shape, np.nan), np.full(shape, np.nan)
    readings[:, 0], sigma[:, 0] = exposures.readings_px[first], exposures.sigma_px[first]
    all_lit = np.ones(len(time_s), dtype=np.bool_)
    for column, rows in enumerate(lit[1:], start=1):
        if len(rows) < 2:
            all_lit[:] = False
            continue
        own = exposures.time_s[rows]
        after = np.clip(np.searchsorted(own, time_s), 1, len(rows) - 1)
        span = own[after] - own[after - 1]
        share = (time_s - own[after - 1]) / span
        known = (share >= 0.0) & (share <= 1.0) & (span <= MAX_GAP_CYCLES * cycle_s)
        all_lit &= known
        share = np.where(known, share, np.nan)[:, None]
        before, behind = rows[after - 1], rows[after]
        readings[:, column] = (1.0 - share) * exposures.readings_px[before]
        readings[:, column] += share * exposures.readings_px[behind]
        sigma[:, column] = np.hypot(
            (1.0 - share) * exposures.sigma_px[before], share * exposures.sigma_px[behind]
        )
    return readings, sigma, all_lit


def _has_moved(readings_px: Array, before_px: Array, pixels: Array) -> bool:
    """Return whether a pose differs from the one before; true where no sensor saw both."""
    change = np.abs(readings_px - before_px) / pixels
    both = np.isfinite(change)
    return not both.any() or bool(change[both].mean() >= MIN_MOTION)
