"""State of a signal chain: scans after each step, and the delay so far."""

from dataclasses import dataclass, field
from math import ceil

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from compute.signal.thesis_pipeline.result import Stage
from compute.signal.thesis_pipeline.steps import Array, ScanFilter


@dataclass
class PipelineState:
    """Scans on their way through the chain.

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
    def scans(self) -> Array:
        """The scans after the last step."""
        return self.stages[-1].scans

    def add(self, name: str, scans: Array, shift_px: float = 0.0) -> None:
        """Add the scans that a step gives.

        Args:
            name: of the step.
            scans: shape (L, P).
            shift_px: shift to the right by the step [px].
        """
        self.shift_px += shift_px
        self.stages.append(Stage(name, scans, self.shift_px))

    def filter(self, through: ScanFilter) -> None:
        """Filter the scans, which grow by the delay that is compensated."""
        padding_px = _padding_px(through)
        longer = np.pad(self.scans, ((0, 0), (0, padding_px)), mode="edge")
        self.add("filtered", through.apply(longer), through.shift_px)


def filter_adjoint(through: ScanFilter, weights: Array) -> Array:
    """Carry derivatives by filtered pixels back to the pixels before ``PipelineState.filter``.

    Args:
        through: the filter.
        weights: shape (K, P).
    """
    back = through.adjoint(weights)
    pixels = back.shape[-1] - _padding_px(through)
    result = back[:, :pixels].copy()
    result[:, -1] += back[:, pixels:].sum(axis=1)
    return result


def _padding_px(through: ScanFilter) -> int:
    """Return how much later light at the scan's end comes out, in whole pixels.

    Lines are continued by it with their last value.
    """
    return ceil(through.correction_px)


def average_scans(scans: Array, count: int) -> Array:
    """Average every ``count`` consecutive scans.

    Args:
        scans: shape (L, P).
        count: at least 1; it must divide L.

    Returns:
        The means, shape (L / count, P).

    Raises:
        InvalidParameter: L is no multiple of count.
    """
    if len(scans) % count:
        raise InvalidParameter(
            f"{len(scans)} scans cannot be averaged {count} at a time; their number must be a "
            f"multiple of {count}",
            scans=len(scans),
            count=count,
        )
    return np.asarray(scans.reshape(-1, count, scans.shape[-1]).mean(axis=1))
