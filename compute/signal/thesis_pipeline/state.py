"""Work: lines on their way through a chain, longer by what its filters delay them by."""

from dataclasses import dataclass, field
from math import ceil

import numpy as np
from numpy.typing import NDArray

from compute.signal.thesis_pipeline.result import Stage
from compute.signal.thesis_pipeline.steps import Array, ScanFilter


@dataclass
class PipelineState:
    """Lines on their way.

    Args:
        raw: as given, shape (L, P).
    """

    raw: Array
    stages: list[Stage] = field(default_factory=list)
    background_masks: list[NDArray[np.bool_]] = field(default_factory=list)
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

    def filter(self, through: ScanFilter) -> None:
        """Filter the lines, which get longer by the delay that is to be compensated."""
        padding_px = _padding_px(through)
        longer = np.pad(self.lines, ((0, 0), (0, padding_px)), mode="edge")
        self.add("filtered", through.apply(longer), through.shift_px)


def filter_adjoint(through: ScanFilter, weights: Array) -> Array:
    """Carry derivatives by K filtered lines' pixels back to those before ``PipelineState.filter``."""
    back = through.adjoint(weights)
    pixels = back.shape[-1] - _padding_px(through)
    result = back[:, :pixels].copy()
    result[:, -1] += back[:, pixels:].sum(axis=1)
    return result


def _padding_px(through: ScanFilter) -> int:
    """Return how much later light at the line's end comes out, in whole pixels.

    Lines are continued by it with their last value.
    """
    return ceil(through.correction_px)
