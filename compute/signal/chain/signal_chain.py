"""SignalChain: from raw lines to positions as chapter 4 of the thesis does it, step by step."""

from dataclasses import dataclass, field
from typing import Final, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from compute.errors import InvalidParameter
from compute.signal.chain.areas import WeightedAreas, areas_above
from compute.signal.chain.averaging import average_lines
from compute.signal.chain.background import BridgedBackground, PeakMask
from compute.signal.chain.filters import ButterworthFilter
from compute.signal.chain.gravity import Centroid, centre_of_gravity
from compute.signal.chain.result import ChainResult, FoundPeak, Stage, batch_of
from compute.signal.chain.separation import Piece, Separation, SlopeExtension
from compute.signal.chain.step import (
    Array,
    Background,
    LineFilter,
    as_lines,
    check_between,
    check_whole,
)
from compute.signal.noise import LineNoise
from compute.signal.peaks import PeakFlag
from compute.signal.settings import Weighting

MOST_REPEATS: Final = 20
_BLOCK: Final = 1_000_000


@dataclass(frozen=True)
class SignalChain:
    """The steps of thesis 4.2 and 4.4 and their settings; a step that is None is left out.

    In this order: lines are averaged and filtered; the background is subtracted and the rest
    filtered again, as often as wanted; weak areas are dropped; close peaks taken apart; each
    peak's centre of gravity [4.1] is taken above its own threshold. The thesis's amplification
    by a whole number (4.4, step 3) changes no position and is not there.

    The sum of the filters' ``correction_px`` is subtracted from the positions.

    Without separation each area above the level has one peak, its maximum, unless a higher one
    lies in the same run above the peak's own threshold.

    Args:
        average: lines that follow one another and are averaged.
        line_filter: before the background is taken.
        background: subtracted, as often as ``repeats`` says.
        filter_after: after each subtraction.
        repeats: 1 to 20.
        areas: the weighted area filter of section 6.2.1.
        separation: of close peaks; it has a level of its own.
        level_fraction: least maximum of a peak as a fraction of the line's greatest value, 0 to
            0.95; thesis 4.5: 1/5.
        threshold_fraction: a peak's own threshold as a fraction of its maximum, 0 to 0.95; 1/3
            for active targets. With separation the maximum is above the zero line.
        weighting: what the centre of gravity weighs: ``centre_of_gravity``.
        min_width_px: fewest pixels above a peak's threshold.

    Raises:
        InvalidParameter: a value outside its range.
    """

    average: int | None = None
    line_filter: LineFilter | None = None
    background: Background | None = None
    filter_after: LineFilter | None = None
    repeats: int = 1
    areas: WeightedAreas | None = None
    separation: Separation | None = None
    level_fraction: float = 0.2
    threshold_fraction: float = 1.0 / 3.0
    weighting: Weighting = "edge-corrected"
    min_width_px: int = 2

    def __post_init__(self) -> None:
        if self.average is not None:
            check_whole("average", self.average, 1, _BLOCK)
        check_whole("repeats", self.repeats, 1, MOST_REPEATS)
        check_whole("min_width_px", self.min_width_px, 1, _BLOCK)
        check_between("level_fraction", self.level_fraction, 0.0, 0.95)
        check_between("threshold_fraction", self.threshold_fraction, 0.0, 0.95)
        if self.weighting not in get_args(Weighting):
            raise InvalidParameter(
                f"weighting is {self.weighting!r}; it must be one of {get_args(Weighting)}",
                weighting=self.weighting,
            )

    @classmethod
    def active(cls, line_filter: LineFilter | None = None) -> "SignalChain":
        """Return the chain of section 4.2.2: a filter, and a third of the maximum subtracted."""
        return cls(line_filter=line_filter, weighting="above-threshold")

    @classmethod
    def passive(cls, average: int | None = None, level_fraction: float = 0.2) -> "SignalChain":
        """Return the chain of section 4.4, Tests 4.1 and 4.2, with the separation of 4.5.

        Filtered against the noise of digitisation, the peaks cut out and bridged, the
        background so made filtered and subtracted, a zero line at 1/5 of the line's greatest
        value, slopes extended. The text gives no filter: here the Butterworth filter that it
        shows in Figure 4.7 (order 4, cut-off 0.4), without its phase; and no threshold for the
        centre of gravity: here all above the zero line.

        Args:
            average: lines that are averaged.
            level_fraction: the zero line. Beside an active target, several times as bright,
                passive ones lie below 1/5: Test 4.1 needs less.
        """
        smooth = ButterworthFilter(4, 0.4)
        return cls(
            average=average,
            line_filter=smooth,
            background=BridgedBackground(PeakMask(degree=7), smooth),
            separation=SlopeExtension(level_fraction, least_depth=0.05),
            threshold_fraction=0.0,
            min_width_px=3,
        )

    @property
    def correction_px(self) -> float:
        """What is subtracted from positions for the filters' delays [px]."""
        first = self.line_filter.correction_px if self.line_filter else 0.0
        after = self.filter_after.correction_px if self.filter_after else 0.0
        return first + after * (self.repeats if self.background else 0)

    def run(self, lines: ArrayLike, noise: LineNoise | None = None) -> ChainResult:
        """Find the peaks of lines.

        Args:
            lines: raw values, shape (P,) or (..., L, P); leading axes become one.
            noise: of the sensors, line l being sensor ``l % S``'s before lines are averaged;
                None: standard deviations are NaN, and no peak is flagged as saturated.

        Returns:
            The peaks of each line, averaged ones counting as one, and all lines in between.
            Standard deviations are those of the pixels' noise through averaging, filters,
            background and centre of gravity, thresholds included. For a median filter it is
            assumed that noise passes unchanged; pixels that an extended slope made count as
            exact; which pixels are background, peak or zero is taken as given. Flags: clipped
            (the run meets an end of the line), merged (cut at a valley), saturated.

        Raises:
            InvalidParameter: lines that cannot be averaged, or lengths out of range.
            NonFiniteValue: a value is NaN or infinite.
        """
        raw = as_lines(lines)
        raw = raw.reshape(-1, raw.shape[-1])
        work = _Work(raw)
        if self.average is not None:
            work.add("averaged", average_lines(raw, self.average))
        if self.line_filter is not None:
            work.add("filtered", self.line_filter.apply(work.lines), self.line_filter.shift_px)
        for _ in range(self.repeats if self.background is not None else 0):
            self._subtract(work)
        if self.areas is not None:
            work.add("weighted", self.areas.apply(work.lines))

        variance, full = self._pixel_noise(raw, noise)
        pieces, found = [], []
        for number, line in enumerate(work.lines):
            parts, peaks = self._peaks_of(line)
            pieces.append(parts)
            finish = _Finish(
                self.correction_px,
                work.shift_px,
                None if variance is None else variance[number],
                None if full is None else full[number],
            )
            found.append(
                [
                    finish.peak(centre, height, self._to_pixels(centre.derivative, work, number), m)
                    for centre, height, m in peaks
                ]
            )
        free = work.free[-1] if work.free else None
        return ChainResult(tuple(work.stages), free, tuple(pieces), batch_of(found))

    def _subtract(self, work: "_Work") -> None:
        assert self.background is not None
        background, free = self.background.estimate(work.lines)
        before = work.lines
        work.add("background", background)
        work.add("subtracted", before - background)
        work.free.append(free)
        if self.filter_after is not None:
            work.add("filtered", self.filter_after.apply(work.lines), self.filter_after.shift_px)

    def _pixel_noise(
        self, raw: Array, noise: LineNoise | None
    ) -> tuple[Array | None, NDArray[np.bool_] | None]:
        """Return the variances of the pixels of averaged lines, and which are saturated."""
        if noise is None:
            return None, None
        sensor = np.arange(len(raw)) % len(noise)
        light = np.maximum(raw - noise.offset_counts[sensor, None], 0.0)
        variance = noise.dark_variance[sensor, None] + noise.photon_variance[sensor, None] * light
        full = raw >= noise.full_scale_counts[sensor, None]
        if self.average is None:
            return variance, full
        return (
            average_lines(variance, self.average) / self.average,
            average_lines(full, self.average) > 0.0,
        )

    def _peaks_of(
        self, line: Array
    ) -> tuple[tuple[Piece, ...], list[tuple[Centroid, float, bool]]]:
        """Return a line's pieces, and of each peak its centroid, height, and whether it was cut."""
        pieces: tuple[Piece, ...] = ()
        tops: list[tuple[Array, int, bool]] = []
        if self.separation is not None:
            pieces = self.separation.separate(line)
            tops = [(p.values, p.top_px, p.cut_left or p.cut_right) for p in pieces]
        else:
            for area in areas_above(line, self.level_fraction * max(float(line.max()), 0.0)):
                run = line[area.first_px : area.last_px + 1]
                tops.append((line, area.first_px + int(run.argmax()), False))
        peaks = []
        for values, top, cut in tops:
            found = centre_of_gravity(values, top, self.threshold_fraction, self.weighting)
            run = values[found.first_px : found.last_px + 1]
            if len(run) >= self.min_width_px and run.max() <= values[top]:
                peaks.append((found, float(line[top]), cut))
        return pieces, peaks

    def _to_pixels(self, derivative: Array, work: "_Work", number: int) -> Array:
        """Carry derivatives by the last line's pixels back to those of the (averaged) raw one."""
        weights = derivative
        for free in reversed(work.free):
            if self.filter_after is not None:
                weights = self.filter_after.adjoint(weights)
            assert self.background is not None
            weights = self.background.adjoint(weights, free[number])
        return weights if self.line_filter is None else self.line_filter.adjoint(weights)


@dataclass
class _Work:
    """Lines on their way."""

    raw: Array
    stages: list[Stage] = field(default_factory=list)
    free: list[NDArray[np.bool_]] = field(default_factory=list)
    shift_px: float = 0.0

    def __post_init__(self) -> None:
        self.add("raw", self.raw)

    @property
    def lines(self) -> Array:
        return self.stages[-1].lines

    def add(self, name: str, lines: Array, shift_px: float = 0.0) -> None:
        self.shift_px += shift_px
        self.stages.append(Stage(name, lines, self.shift_px))


@dataclass(frozen=True, eq=False)
class _Finish:
    """What makes a peak of a centroid on one line."""

    correction_px: float
    shift_px: float
    variance: Array | None
    full: NDArray[np.bool_] | None

    def peak(self, centre: Centroid, height: float, weights: Array, cut: bool) -> FoundPeak:
        pixels = len(weights)
        flags = PeakFlag.MERGED if cut else PeakFlag.NONE
        if centre.first_px == 0 or centre.last_px == pixels - 1:
            flags |= PeakFlag.CLIPPED
        if self.full is not None:
            first = max(int(np.floor(centre.first_px - self.shift_px)), 0)
            last = max(int(np.ceil(centre.last_px - self.shift_px)), 0)
            if self.full[first : last + 1].any():
                flags |= PeakFlag.SATURATED
        sigma = float("nan") if self.variance is None else float(weights**2 @ self.variance) ** 0.5
        return FoundPeak(
            centre.position_px - self.correction_px, sigma, height, centre.width_px, flags
        )
