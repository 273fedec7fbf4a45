"""Result of the signal chain: peaks, and the scans after each step."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from compute.signal.peaks import PeakBatch, PeakFlag
from compute.signal.thesis_pipeline.centroid import Centroid
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


class PipelinePeak(NamedTuple):
    """One peak of a chain: the fields of PeakBatch."""

    position_px: float
    sigma_px: float
    amplitude: float
    width_px: float
    flags: int


@dataclass(frozen=True, eq=False)
class PeakOutput:
    """Conversion of the centroids of one scan to peaks.

    Args:
        pixels: of the raw scan.
        correction_px: subtracted from positions.
        shift_px: by how much the last scan lies to the right of the light.
        reach_px: how near to an end what lies beyond it weighs in.
        variance: of the raw scan's pixels, shape (P,); None: not known.
        full: which of them are saturated, shape (P,); None: not known.
    """

    pixels: int
    correction_px: float
    shift_px: float
    reach_px: float
    variance: Array | None
    full: NDArray[np.bool_] | None

    def peak(
        self, centre: Centroid, height: float, derivative: Array | None, cut: bool
    ) -> PipelinePeak | None:
        """Return a peak; None: it is none.

        None are centres that the filters' delay puts off the scan, and those that are less sure
        than they are wide: noise has such where there is no light.

        Args:
            centre: on the last scan.
            height: above its background.
            derivative: of the position by each raw pixel, shape (P,); None: not known.
            cut: whether it is cut at a valley.
        """
        position = centre.position_px - self.correction_px
        if not -0.5 <= position <= self.pixels - 0.5:
            return None
        sigma = float("nan")
        if self.variance is not None and derivative is not None:
            sigma = float(derivative**2 @ self.variance) ** 0.5
            if sigma > centre.width_px:
                return None
        first, last = centre.first_px - self.shift_px, centre.last_px - self.shift_px
        flags = PeakFlag.MERGED if cut else PeakFlag.NONE
        if first - self.reach_px <= 0.0 or last + self.reach_px >= self.pixels - 1:
            flags |= PeakFlag.CLIPPED
        if self.full is not None:
            run = slice(max(int(np.floor(first)), 0), max(int(np.ceil(last)), 0) + 1)
            if self.full[run].any():
                flags |= PeakFlag.SATURATED
        return PipelinePeak(position, sigma, height, centre.width_px, flags)


def to_peak_batch(pipeline_peaks: list[list[PipelinePeak]]) -> PeakBatch:
    """Return the peaks of L scans as arrays, ordered by position, room for the most of a scan."""
    batch = PeakBatch.empty(
        len(pipeline_peaks), max((len(peaks) for peaks in pipeline_peaks), default=0)
    )
    for scan, peaks in enumerate(pipeline_peaks):
        batch.count[scan] = len(peaks)
        ordered = sorted(peaks, key=lambda peak: peak.position_px)
        for name, values in zip(PipelinePeak._fields, zip(*ordered, strict=True), strict=False):
            getattr(batch, name)[scan, : len(peaks)] = values
    return batch
