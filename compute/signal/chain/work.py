"""Work: lines on their way through a chain, longer by what its filters delay them by."""

from dataclasses import dataclass, field
from math import ceil

import numpy as np
from numpy.typing import NDArray

from compute.signal.chain.result import Stage
from compute.signal.chain.step import Array, LineFilter


@dataclass
class Work:
    """Lines on their way.

    Args:
        raw: as given, shape (L, P).
    """

    raw: Array
    stages: list[Stage] = field(default_factory=list)
    free: list[NDArray[np.bool_]] = field(default_factory=list)
    shift_px: float = 0.0

    def __post_init__(self) -> None:
        self.add("raw", self.raw)

    @property
    def lines(self) -> Array:
        """The lines after the last step."""
        return self.stages[-1].lines

    def add(self, name: str, lines: Array, shift_px: float = 0.0) -> None:
        """Add what a step made of the lines, and by how much it moved them."""
        self.shift_px += shift_px
        self.stages.append(Stage(name, lines, self.shift_px))

    def filter(self, through: LineFilter) -> None:
        """Filter the lines, which get longer by the delay that is to be compensated."""
        room = _room(through)
        longer = np.pad(self.lines, ((0, 0), (0, room)), mode="edge")
        self.add("filtered", through.apply(longer), through.shift_px)


def unfiltered(through: LineFilter, weights: Array) -> Array:
    """Carry derivatives by K filtered lines' pixels back to those before ``Work.filter``."""
    back = through.adjoint(weights)
    pixels = back.shape[-1] - _room(through)
    result = back[:, :pixels].copy()
    result[:, -1] += back[:, pixels:].sum(axis=1)
    return result


def _room(through: LineFilter) -> int:
    """Return how much later light at the line's end comes out, in whole pixels.

    Lines are continued by it with their last value.
    """
    return ceil(through.correction_px)
