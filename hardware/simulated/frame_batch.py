"""Batches of rendered exposures, their timing, and the base of their renderers."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.optics.detector import Detector
from compute.optics.detector_array import DetectorArray
from hardware.simulated.pixel_defects import DefectiveDetector

BATCH: Final = 8
"""Frames per batch; a frame's noise depends on it."""


@dataclass(frozen=True, eq=False)
class Batch:
    """BATCH consecutive exposures.

    Args:
        lines: counts, uint16, shape (BATCH, sensors, pixels), read-only.
        saturated: whether an exposure has a saturated pixel, shape (BATCH,).
    """

    lines: NDArray[np.uint16]
    saturated: NDArray[np.bool_]


@dataclass(frozen=True)
class Timing:
    """When exposures are made, and which marker each lights.

    Args:
        frame_rate_hz: exposures per second.
        strobed_markers: their number; 0: all markers are lit together.
        duration_s: length of the scene [s]; None: endless.
        realtime: whether a frame is delivered when it is exposed, and not before.
        schedule: the markers that exposures light, one after the other and again from the first;
            empty: each of the strobed ones in turn.
    """

    frame_rate_hz: float
    strobed_markers: int
    duration_s: float | None
    realtime: bool
    schedule: tuple[int, ...] = ()

    @property
    def frames(self) -> int | None:
        """Number of exposures in the duration, at least one; None: endless."""
        if self.duration_s is None:
            return None
        # A fraction of a frame forgives the rounding of a product meant to be whole.
        return max(1, int(self.duration_s * self.frame_rate_hz + 5e-7))

    def time_s(self, sequence: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the centres of exposures on the device's clock, same shape [s]."""
        return (sequence.astype(np.float64) + 0.5) / self.frame_rate_hz

    def time_ns(self, sequence: int) -> int:
        """Return the centre of an exposure on the device's clock [ns]."""
        return round((sequence + 0.5) * 1e9 / self.frame_rate_hz)

    def marker(self, sequence: int) -> int | None:
        """Return the marker lit in an exposure; None: all."""
        if self.schedule:
            return self.schedule[sequence % len(self.schedule)]
        return sequence % self.strobed_markers if self.strobed_markers else None

    def lit(
        self, points_mm: NDArray[np.float64], sequence: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """Return the positions of the lit markers in F exposures, shape (F, lit markers, 3) [mm].

        Args:
            points_mm: all markers at the exposures' times, shape (F, M, 3) [mm].
            sequence: the exposures' numbers, shape (F,).
        """
        if not self.strobed_markers:
            return points_mm
        slots = np.array(self.schedule or range(self.strobed_markers))
        lit: NDArray[np.float64] = points_mm[np.arange(len(sequence)), slots[sequence % len(slots)]]
        return lit[:, None]


class Renderer(ABC):
    """Renders exposures by number, reproducibly and in any order.

    Args:
        detector: its pixels.
        full_counts: smallest count of a saturated pixel.
        seed: of the noise; that of a batch depends on its number, too.
    """

    def __init__(
        self, detector: Detector | DetectorArray | DefectiveDetector, full_counts: int, seed: int
    ) -> None:
        self._detector = detector
        self._full_counts = full_counts
        self._seed = seed
        self.begin_s = 0.0
        """Time of the scene when the device's clock begins [s]."""

    @abstractmethod
    def signal_electrons(self, sequence: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the mean electrons of the markers in N exposures, shape (N, sensors, pixels)."""

    def batch(self, number: int) -> Batch:
        """Render exposures ``BATCH * number`` to ``BATCH * (number + 1) - 1``."""
        sequence = np.arange(BATCH * number, BATCH * (number + 1), dtype=np.int64)
        seeds = np.random.SeedSequence(self._seed, spawn_key=(number,))
        rng = np.random.Generator(np.random.SFC64(seeds))
        lines = self._detector.expose(self.signal_electrons(sequence), rng)
        lines.setflags(write=False)
        return Batch(lines, lines.max(axis=(1, 2)) >= self._full_counts)
