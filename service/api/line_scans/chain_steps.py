"""Steps of the thesis's signal chain in requests, discriminated by `kind`."""

from dataclasses import asdict, field
from typing import Annotated, Final, Literal

from pydantic import ConfigDict, Field, TypeAdapter
from pydantic.dataclasses import dataclass as checked_dataclass

from compute.signal.centroid_settings import Weighting
from compute.signal.thesis_pipeline.area_detection import WeightedAreas
from compute.signal.thesis_pipeline.background_subtraction import (
    MAX_DEGREE,
    InterpolatedBackground,
    PeakMask,
    PolynomialBackground,
)
from compute.signal.thesis_pipeline.filters import ButterworthFilter, FirFilter, MedianFilter
from compute.signal.thesis_pipeline.peak_separation import SlopeExtension, ValleyCut
from compute.signal.thesis_pipeline.signal_chain import SignalChain
from compute.signal.thesis_pipeline.steps import MAX_TAPS, Compensation

STRICT: Final = ConfigDict(extra="forbid", allow_inf_nan=False)
MAX_AVERAGED: Final = 256

# What the most of all at once may cost a request; compute itself allows more.
MAX_REPEATS: Final = 5
MAX_ROUNDS: Final = 50
MAX_CHAIN_PEAKS: Final = 64
LONGEST_MEDIAN: Final = 255
HIGHEST_ORDER: Final = 24

# Below, sections of high order no longer hold their poles apart in float64.
Cutoff = Annotated[
    float, Field(ge=0.01, le=0.99, description="As a fraction of half the sampling rate.")
]
Share = Annotated[float, Field(ge=0.0, le=1.0)]
Level = Annotated[float, Field(ge=0.0, le=0.95)]
Degree = Annotated[int, Field(ge=0, le=MAX_DEGREE)]
Above = Annotated[float, Field(ge=1.0, le=100.0)]
Margin = Annotated[int, Field(ge=0, le=1000)]
Rounds = Annotated[int, Field(ge=1, le=MAX_ROUNDS)]


@checked_dataclass(frozen=True, config=STRICT)
class Median(MedianFilter):
    """The median of neighbouring pixels."""

    aperture: Annotated[int, Field(ge=1, le=LONGEST_MEDIAN)]
    compensation: Literal["none", "delay"] = "delay"
    kind: Literal["median"] = "median"


@checked_dataclass(frozen=True, config=STRICT)
class Butterworth(ButterworthFilter):
    """A Butterworth low pass."""

    order: Annotated[int, Field(ge=1, le=HIGHEST_ORDER)]
    cutoff: Cutoff
    compensation: Compensation = ButterworthFilter.compensation
    kind: Literal["butterworth"] = "butterworth"


@checked_dataclass(frozen=True, config=STRICT)
class Fir(FirFilter):
    """A low pass of finite impulse response."""

    taps: Annotated[int, Field(ge=2, le=MAX_TAPS)]
    cutoff: Cutoff
    compensation: Compensation = FirFilter.compensation
    kind: Literal["fir"] = "fir"


Filter = Annotated[Median | Butterworth | Fir, Field(discriminator="kind")]


@checked_dataclass(frozen=True, config=STRICT)
class Mask(PeakMask):
    """Mask of the pixels of peaks, for the background."""

    degree: Degree = PeakMask.degree
    above_sigma: Above = PeakMask.above_sigma
    margin_px: Margin = PeakMask.margin_px
    rounds: Rounds = PeakMask.rounds


@checked_dataclass(frozen=True, config=STRICT)
class Polynomial(PolynomialBackground):
    """A polynomial through the pixels between the peaks."""

    degree: Degree = PolynomialBackground.degree
    above_sigma: Above = PolynomialBackground.above_sigma
    margin_px: Margin = PolynomialBackground.margin_px
    rounds: Rounds = PolynomialBackground.rounds
    kind: Literal["polynomial"] = "polynomial"


@checked_dataclass(frozen=True, config=STRICT)
class Bridged(InterpolatedBackground):
    """The line with its peaks cut out and the gaps bridged."""

    mask: Mask = field(default_factory=Mask)
    smoothing: Filter | None = None
    kind: Literal["bridged"] = "bridged"


@checked_dataclass(frozen=True, config=STRICT)
class Areas(WeightedAreas):
    """Areas whose maximum times sum is large."""

    level_fraction: Level = WeightedAreas.level_fraction
    keep_fraction: Share = WeightedAreas.keep_fraction


@checked_dataclass(frozen=True, config=STRICT)
class Valley(ValleyCut):
    """Peaks cut apart at the valleys."""

    level_fraction: Level = ValleyCut.level_fraction
    min_depth: Share = ValleyCut.min_depth
    kind: Literal["valley-cut"] = "valley-cut"


@checked_dataclass(frozen=True, config=STRICT)
class Slope(SlopeExtension):
    """Peaks cut at the valleys, and the cut slopes continued."""

    level_fraction: Level = SlopeExtension.level_fraction
    min_depth: Share = SlopeExtension.min_depth
    stop_fraction: Annotated[float, Field(ge=1e-4, le=0.5)] = SlopeExtension.stop_fraction
    kind: Literal["slope-extension"] = "slope-extension"


@checked_dataclass(frozen=True, config=STRICT)
class ChainMethod(SignalChain):
    """The chain of the thesis's chapter 4; a step that is null is left out."""

    method: Literal["chain"] = "chain"
    average: Annotated[int, Field(ge=1, le=MAX_AVERAGED)] | None = SignalChain.average
    line_filter: Filter | None = None
    background: Annotated[Polynomial | Bridged, Field(discriminator="kind")] | None = None
    filter_after: Filter | None = None
    repeats: Annotated[int, Field(ge=1, le=MAX_REPEATS)] = SignalChain.repeats
    areas: Areas | None = None
    separation: Annotated[Valley | Slope, Field(discriminator="kind")] | None = None
    level_fraction: Level = SignalChain.level_fraction
    threshold_fraction: Level = SignalChain.threshold_fraction
    weighting: Weighting = SignalChain.weighting
    min_width_px: Annotated[int, Field(ge=1, le=1_000_000)] = SignalChain.min_width_px
    max_peaks: Annotated[int, Field(ge=1, le=MAX_CHAIN_PEAKS)] = MAX_CHAIN_PEAKS


def passive_chain() -> ChainMethod:
    """Return ``SignalChain.passive()`` as clients would set it."""
    chain = asdict(SignalChain.passive()) | {"max_peaks": MAX_CHAIN_PEAKS}
    chain["line_filter"]["kind"] = chain["background"]["smoothing"]["kind"] = "butterworth"
    chain["background"]["kind"], chain["separation"]["kind"] = "bridged", "slope-extension"
    return TypeAdapter(ChainMethod).validate_python(chain)
