"""Reassembles exposures that a device sends in several messages."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hardware.serial.messages import Lines, LinesFlag


@dataclass(frozen=True, eq=False, slots=True)
class AssembledExposure:
    """A complete exposure, see ``messages.Lines``; counts (sensors, pixels), read-only."""

    sequence: int
    ticks: int
    marker: int
    flags: LinesFlag
    lost: int
    lines: NDArray[np.uint16]


class ExposureAssembler:
    """Reassembles exposures of (sensors, pixels) from parts in order.

    Attributes:
        incomplete: exposures with a missing part.
        orphaned: parts without an exposure: its beginning was lost, or they do not fit.
    """

    def __init__(self, sensors: int, pixels: int) -> None:
        self.incomplete = 0
        self.orphaned = 0
        self._shape = (sensors, pixels)
        self._size = sensors * pixels
        self._begun: Lines | None = None
        self._filled = 0
        self._flags = LinesFlag.NONE
        self._counts = np.empty(0, dtype=np.uint16)

    def reset(self) -> None:
        """Discard an unfinished exposure without counting it."""
        self._begun = None

    def add(self, part: Lines) -> AssembledExposure | None:
        """Add a part; return the exposure that it completes."""
        if part.first == 0 and len(part.counts) == self._size:
            self._drop()
            return self._whole(part, part.counts, part.flags)
        begun = self._begun
        end = part.first + len(part.counts)
        if part.first == 0 and end < self._size:
            self._drop()
            self._begun, self._filled, self._flags = part, end, part.flags
            self._counts = np.empty(self._size, dtype=np.uint16)
            self._counts[:end] = part.counts
            return None
        if (
            begun is None
            or (part.sequence, part.ticks) != (begun.sequence, begun.ticks)
            or part.first != self._filled
            or end > self._size
        ):
            self._drop()
            self.orphaned += 1
            return None
        self._counts[part.first : end] = part.counts
        self._filled = end
        self._flags |= part.flags
        if end < self._size:
            return None
        self._begun = None
        self._counts.setflags(write=False)
        return self._whole(part, self._counts, self._flags)

    def _drop(self) -> None:
        if self._begun is not None:
            self._begun = None
            self.incomplete += 1

    def _whole(
        self, part: Lines, counts: NDArray[np.uint16], flags: LinesFlag
    ) -> AssembledExposure:
        lines = counts.reshape(self._shape)
        return AssembledExposure(part.sequence, part.ticks, part.marker, flags, part.lost, lines)
