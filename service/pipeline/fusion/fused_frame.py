"""FusedFrame: peaks of several bars at one time, in place of scans."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.fusion.clock_errors import PeakRates
from compute.signal.peaks import PeakBatch
from hardware.line_frame import LineFrame

Array = NDArray[np.float64]

PEAK_ARRAYS: Final = (
    "position_px",
    "sigma_px",
    "amplitude",
    "width_px",
    "flags",
    "reduced_chi2",
    "covariance_px2",
)
"""Arrays of a PeakBatch by scan and peak; ``count`` is by scan."""


def _no_rates() -> PeakRates:
    return PeakRates(*(np.empty((0, 0)) for _ in range(3)))


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class FusedFrame(LineFrame):
    """What all bars saw at the time of the reference's exposure; ``lines`` is empty.

    Args:
        peaks: of the S sensors of all bars, one bar behind the other.
        rates: how fast they change, shape (S, K).
        bar_of_sensor: number of each sensor's clock among the B that are not the reference's; -1:
            it is the reference's, or its bar is away, shape (S,).
        clock_sigma_s: standard deviation of each of these clocks against the reference's, by the
            number of the bar, shape (B,) [s].
        reference: number of the bar whose clock and exposures give the times.
    """

    peaks: PeakBatch
    rates: PeakRates = field(default_factory=_no_rates)
    bar_of_sensor: NDArray[np.intp]
    clock_sigma_s: Array
    reference: int


def join_peaks(frames: Sequence[LineFrame]) -> PeakBatch:
    """Return the peaks of fused frames as one batch, scan by scan.

    Args:
        frames: F fused frames of S sensors, one or more.
    """
    parts = [_fused(frame).peaks for frame in frames]
    if len(parts) == 1:
        return parts[0]
    room = max(part.position_px.shape[1] for part in parts)
    joined = PeakBatch.empty(sum(len(part) for part in parts), room)
    first = 0
    for part in parts:
        last, columns = first + len(part), part.position_px.shape[1]
        joined.count[first:last] = part.count
        for name in PEAK_ARRAYS:
            getattr(joined, name)[first:last, :columns] = getattr(part, name)
        first = last
    return joined


def rates_of(frame: LineFrame, room: int) -> PeakRates:
    """Return the rates of a fused frame's peaks, with room for so many a scan."""
    rates = _fused(frame).rates
    missing = room - rates.rate_px_s.shape[1]
    if not missing:
        return rates
    return PeakRates(*(np.pad(values, ((0, 0), (0, missing))) for values in vars(rates).values()))


def _fused(frame: LineFrame) -> FusedFrame:
    assert isinstance(frame, FusedFrame)
    return frame
