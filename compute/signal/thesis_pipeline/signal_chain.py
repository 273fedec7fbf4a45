"""The signal chain of chapter 4 of the thesis: from raw scans to positions."""

from dataclasses import dataclass
from typing import Final, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from compute.errors import InvalidParameter
from compute.signal.centroid_settings import (
    Weighting,
    require_between,
    require_choice,
    require_integer,
)
from compute.signal.peaks import PeakFlag
from compute.signal.sensor_noise import SensorNoise
from compute.signal.thesis_pipeline.area_detection import WeightedAreas, areas_above
from compute.signal.thesis_pipeline.background_subtraction import InterpolatedBackground, PeakMask
from compute.signal.thesis_pipeline.centroid import Centroid, centre_of_gravity
from compute.signal.thesis_pipeline.filters import ButterworthFilter
from compute.signal.thesis_pipeline.peak_separation import (
    PeakSegment,
    SlopeExtension,
    ValleyCut,
)
from compute.signal.thesis_pipeline.result import (
    ChainResult,
    PeakOutput,
    PipelinePeak,
    to_peak_batch,
)
from compute.signal.thesis_pipeline.state import PipelineState, average_scans, filter_adjoint
from compute.signal.thesis_pipeline.steps import Array, Background, ScanFilter, as_scans

MAX_REPEATS: Final = 20
MAX_PEAKS: Final = 65536
_BLOCK: Final = 1_000_000

_Centre = tuple[Centroid, float, bool]
"""A centre of gravity, its height, and whether a valley cuts its peak."""


@dataclass(frozen=True)
class SignalChain:
    """The steps of thesis 4.2 and 4.4 and their settings; a step that is None is left out.

    In this order: scans are averaged and filtered; the background is subtracted and the rest
    filtered again, as often as wanted; weak areas are dropped; close peaks taken apart; each
    peak's centre of gravity [4.1] is taken above its own threshold. The thesis's amplification
    by a whole number (4.4, step 3) changes no position and is not there.

    The sum of the filters' ``correction_px`` is subtracted from the positions. Lines are
    continued by as much with their last value, as light at their end leaves the filters so much
    later; a chain that delays by a whole scan is refused.

    Without separation each area above the level has one peak, its maximum, unless a higher one
    lies in the same run above the peak's own threshold.

    Args:
        average: scans that follow one another and are averaged.
        line_filter: before the background is taken.
        background: subtracted, as often as ``repeats`` says.
        filter_after: after each subtraction.
        repeats: 1 to 20.
        areas: the weighted area filter of section 6.2.1.
        separation: of close peaks; it has a level of its own.
        level_fraction: minimum height of a peak as a fraction of the scan's greatest value, 0 to
            0.95; thesis 4.5: 1/5.
        threshold_fraction: a peak's own threshold as a fraction of its maximum, 0 to 0.95; 1/3
            for active targets. With separation the maximum is above the zero line.
        weighting: what the centre of gravity weighs: ``centre_of_gravity``.
        min_width_px: minimum number of pixels above a peak's threshold.
        max_peaks: of one scan, 1 to 65536; of more the highest are kept, TRUNCATED.

    Raises:
        InvalidParameter: a value outside its range.
    """

    average: int | None = None
    line_filter: ScanFilter | None = None
    background: Background | None = None
    filter_after: ScanFilter | None = None
    repeats: int = 1
    areas: WeightedAreas | None = None
    separation: ValleyCut | None = None
    level_fraction: float = 0.2
    threshold_fraction: float = 1.0 / 3.0
    weighting: Weighting = "edge-corrected"
    min_width_px: int = 2
    max_peaks: int = 256

    def __post_init__(self) -> None:
        if self.average is not None:
            require_integer("average", self.average, 1, _BLOCK)
        require_integer("repeats", self.repeats, 1, MAX_REPEATS)
        require_integer("min_width_px", self.min_width_px, 1, _BLOCK)
        require_integer("max_peaks", self.max_peaks, 1, MAX_PEAKS)
        require_between("level_fraction", self.level_fraction, 0.0, 0.95)
        require_between("threshold_fraction", self.threshold_fraction, 0.0, 0.95)
        require_choice("weighting", self.weighting, get_args(Weighting))

    @classmethod
    def active(cls, line_filter: ScanFilter | None = None) -> "SignalChain":
        """Return the chain of section 4.2.2: a filter, and a third of the maximum subtracted."""
        return cls(line_filter=line_filter, weighting="above-threshold")

    @classmethod
    def passive(cls, average: int | None = None, level_fraction: float = 0.2) -> "SignalChain":
        """Return the chain of section 4.4, Tests 4.1 and 4.2, with the separation of 4.5.

        Filtered against the noise of digitisation, the peaks cut out and bridged, the
        background so made filtered and subtracted, a zero line at 1/5 of the scan's greatest
        value, slopes extended. The text gives no filter: here the Butterworth filter that it
        shows in Figure 4.7 (order 4, cut-off 0.4), without its phase; and no threshold for the
        centre of gravity: here all above the zero line.

        Args:
            average: scans that are averaged.
            level_fraction: the zero line. Beside an active target, several times as bright,
                passive ones lie below 1/5: Test 4.1 needs less.
        """
        smooth = ButterworthFilter(4, 0.4)
        return cls(
            average=average,
            line_filter=smooth,
            background=InterpolatedBackground(PeakMask(degree=7), smooth),
            separation=SlopeExtension(level_fraction, min_depth=0.05),
            threshold_fraction=0.0,
            min_width_px=3,
        )

    @property
    def correction_px(self) -> float:
        """Sum of the filters' delays, which is subtracted from positions [px]."""
        return sum(one.correction_px for one in self._filter_sequence())

    @property
    def reach_px(self) -> float:
        """Distance from an end within which pixels beyond it matter, by all filters [px]."""
        return sum(one.reach_px for one in self._filter_sequence())

    def _filter_sequence(self) -> list[ScanFilter]:
        """Return the filters that scans go through, in their order."""
        after = [self.filter_after] * self.repeats if self.background is not None else []
        return [one for one in (self.line_filter, *after) if one is not None]

    def run(self, scans: ArrayLike, noise: SensorNoise | None = None) -> ChainResult:
        """Find the peaks of scans.

        Args:
            scans: raw values, shape (P,) or (..., L, P); leading axes become one.
            noise: of the sensors, scan l being sensor ``l % S``'s before scans are averaged;
                None: standard deviations are NaN, and no peak is flagged as saturated.

        Returns:
            The peaks of each scan, averaged ones counting as one, and all scans in between.
            Standard deviations are those of the pixels' noise through averaging, filters,
            background and centre of gravity, thresholds included. For a median filter it is
            assumed that noise passes unchanged; pixels that an extended slope made count as
            exact; which pixels are background, peak or zero is taken as given. With noise, what
            is less sure than it is wide is no peak. Flags: clipped (the run meets an end of the
            scan, or comes as near to one as ``reach_px``), merged (cut at a valley), saturated,
            truncated.

        Raises:
            InvalidParameter: scans that cannot be averaged, lengths out of range, or filters that
                delay by a whole scan or more.
            NonFiniteValue: a value is NaN or infinite.
        """
        raw = as_scans(scans)
        raw = raw.reshape(-1, raw.shape[-1])
        pixels = raw.shape[-1]
        if self.correction_px >= pixels:
            raise InvalidParameter(
                f"the filters delay scans by {self.correction_px:.6g} px; that must be less than "
                f"the {pixels} pixels of a scan",
                delay_px=self.correction_px,
            )
        state = PipelineState(raw)
        if self.average is not None:
            state.add("averaged", average_scans(raw, self.average))
        if self.line_filter is not None:
            state.filter(self.line_filter)
        for _ in range(self.repeats if self.background is not None else 0):
            self._subtract(state)
        if self.areas is not None:
            state.add("weighted", self.areas.apply(state.scans))

        variance, full = self._pixel_noise(raw, noise)
        segments, found = [], []
        for number, scan in enumerate(state.scans):
            parts, peaks = self._peaks_of(scan)
            segments.append(parts)
            output = PeakOutput(
                pixels,
                self.correction_px,
                state.shift_px,
                self.reach_px,
                None if variance is None else variance[number],
                None if full is None else full[number],
            )
            derivatives = self._to_pixels(peaks, state, number) if noise is not None else None
            found.append(self._to_peaks(output, peaks, derivatives))
        free = state.background_masks[-1] if state.background_masks else None
        return ChainResult(tuple(state.stages), free, tuple(segments), to_peak_batch(found))

    def _subtract(self, state: PipelineState) -> None:
        assert self.background is not None
        background, free = self.background.estimate(state.scans)
        before = state.scans
        state.add("background", background)
        state.add("subtracted", before - background)
        state.background_masks.append(free)
        if self.filter_after is not None:
            state.filter(self.filter_after)

    def _pixel_noise(
        self, raw: Array, noise: SensorNoise | None
    ) -> tuple[Array | None, NDArray[np.bool_] | None]:
        """Return the variances of the pixels of averaged scans, and which are saturated."""
        if noise is None:
            return None, None
        sensor = np.arange(len(raw)) % len(noise)
        variance = noise.of_scans(sensor).variance(raw)
        full = raw >= noise.full_scale_counts[sensor, None]
        if self.average is None:
            return variance, full
        return (
            average_scans(variance, self.average) / self.average,
            average_scans(full.astype(np.float64), self.average) > 0.0,
        )

    def _peaks_of(self, scan: Array) -> tuple[tuple[PeakSegment, ...], list[_Centre]]:
        """Return a scan's pieces and its highest peaks, one more of them than are kept."""
        segments: tuple[PeakSegment, ...] = ()
        tops: list[tuple[Array, int, bool]] = []
        if self.separation is not None:
            segments = self.separation.separate(scan)
            tops = [(p.values, p.top_px, p.cut_left or p.cut_right) for p in segments]
        else:
            for area in areas_above(scan, self.level_fraction * max(float(scan.max()), 0.0)):
                run = scan[area.first_px : area.last_px + 1]
                tops.append((scan, area.first_px + int(run.argmax()), False))
        tops.sort(key=lambda one: -float(one[0][one[1]]))
        peaks: list[_Centre] = []
        for values, top, cut in tops:
            if len(peaks) > self.max_peaks:
                break
            centroid = centre_of_gravity(values, top, self.threshold_fraction, self.weighting)
            run = values[centroid.first_px : centroid.last_px + 1]
            if len(run) >= self.min_width_px and run.max() <= values[top]:
                peaks.append((centroid, float(scan[top]), cut))
        return segments, peaks

    def _to_peaks(
        self, output: PeakOutput, centres: list[_Centre], derivatives: Array | None
    ) -> list[PipelinePeak]:
        truncated = PeakFlag.TRUNCATED if len(centres) > self.max_peaks else PeakFlag.NONE
        peaks = []
        for number, (centre, height, cut) in enumerate(centres[: self.max_peaks]):
            by_pixel = None if derivatives is None else derivatives[number]
            peak = output.peak(centre, height, by_pixel, cut)
            if peak is not None:
                peaks.append(peak._replace(flags=peak.flags | truncated))
        return peaks

    def _to_pixels(self, peaks: list[_Centre], state: PipelineState, number: int) -> Array:
        """Return the derivatives of K centres by the (averaged) raw scan's pixels, (K, P)."""
        if not peaks:
            return np.zeros((0, state.raw.shape[-1]))
        weights = np.array([centre.derivative for centre, _, _ in peaks])
        for free in reversed(state.background_masks):
            if self.filter_after is not None:
                weights = filter_adjoint(self.filter_after, weights)
            assert self.background is not None
            weights = self.background.adjoint(weights, free[number])
        if self.line_filter is not None:
            weights = filter_adjoint(self.line_filter, weights)
        return weights
