"""Result of the signal chain: peaks, and the scans after each step."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from compute.signal.peaks import PeakBatch, PeakFlag
from compute.signal.thesis_pipeline.peak_separation import PeakSegment
from compute.signal.thesis_pipeline.steps import Array


@dataclass(frozen=True, eq=False)
class Stage:
    """Scans after one step.

    Args:
        name: the step.
        scans: shape (L, P), longer by the whole pixels of a delay that is compensated.
        shift_px: by how much the scans lie to the right of the light, by the filters so far [px].
    """

    name: str
    scans: Array
    shift_px: float


@dataclass(frozen=True, eq=False)
class ChainResult:
    """Peaks of L scans, and the intermediate results.

    Args:
        stages: from the given scans to those whose peaks were measured.
        background_mask: the pixels that the last background was taken from, shape of that
            stage's scans; None without background.
        segments: of each scan the separated peaks, not moved back by the delay; empty without
            separation.
        peaks: their positions, moved back by the delays that are compensated.
    """

    stages: tuple[Stage, ...]
    background_mask: NDArray[np.bool_] | None
    segments: tuple[tuple[PeakSegment, ...], ...]
    peaks: PeakBatch

    def stage(self, name: str) -> Stage:
        """Return the last stage of this name.

        Raises:
            InvalidParameter: the chain has no such step.
        """
        for stage in reversed(self.stages):
            if stage.name == name:
                return stage
        names = tuple(stage.name for stage in self.stages)
        raise InvalidParameter(f"there is no stage {name!r}; there are {names}", name=name)


@dataclass(frozen=True)
class PipelinePeak:
    """One peak of a chain: the fields of PeakBatch."""

    position_px: float
    sigma_px: float
    amplitude: float
    width_px: float
    flags: PeakFlag


def to_peak_batch(found: list[list[PipelinePeak]]) -> PeakBatch:
    """Return the peaks of L scans as arrays, ordered by position, room for the most of a scan."""
    room = max((len(peaks) for peaks in found), default=0)
    batch = PeakBatch.empty(len(found), room)
    for scan, peaks in enumerate(found):
        batch.count[scan] = len(peaks)
        for k, peak in enumerate(sorted(peaks, key=lambda one: one.position_px)):
            batch.position_px[scan, k] = peak.position_px
            batch.sigma_px[scan, k] = peak.sigma_px
            batch.amplitude[scan, k] = peak.amplitude
            batch.width_px[scan, k] = peak.width_px
            batch.flags[scan, k] = peak.flags
    return batch
