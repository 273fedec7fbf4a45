"""Peak-finding methods in requests, discriminated by `method`."""

from dataclasses import field, fields
from typing import Annotated, Any, Final, Literal

from pydantic import Field, model_validator
from pydantic.dataclasses import dataclass as checked_dataclass
from pydantic_core import ArgsKwargs

from compute.errors import InvalidParameter
from compute.signal.centroid_settings import MAX_PIXELS, CentroidSettings, Weighting
from compute.signal.detection.matched_filter import LENGTH_IN_WIDTHS
from compute.signal.detection.peak_detector import DetectionSettings, NoiseSource
from compute.signal.fit.fit_settings import WIDTH_LIMITS_PX, BackgroundModel, FitSettings
from compute.signal.fit.line_spread_function import LineSpreadFunction
from compute.signal.peaks import MAX_JOINT_PEAKS
from service.api.line_scans.chain_steps import STRICT, ChainMethod
from service.api.line_scans.line_spread import Shape
from service.api.line_scans.mask_method import MaskMethod

MethodName = Literal["centroid", "fit", "chain", "matched", "mask"]

_SEARCH: Final = FitSettings().search
_LOW_PX, _HIGH_PX = WIDTH_LIMITS_PX
_WIDEST_PX: Final = 100.0
WIDEST_SPREAD: Final = 100.0
_LONGEST_PX: Final = int(LENGTH_IN_WIDTHS * _WIDEST_PX) + 1

Fraction = Annotated[float, Field(ge=0.05, le=0.95)]
Sigmas = Annotated[float, Field(ge=3.0, le=1000.0)]
Pixels = Annotated[int, Field(ge=1, le=MAX_PIXELS)]
Room = Annotated[int, Field(ge=1, le=1024)]


@checked_dataclass(frozen=True, config=STRICT)
class CentroidMethod(CentroidSettings):
    """Threshold and centre of gravity."""

    method: Literal["centroid"] = "centroid"
    threshold_fraction: Fraction = CentroidSettings.threshold_fraction
    detection_sigma: Sigmas = CentroidSettings.detection_sigma
    min_width_px: Pixels = CentroidSettings.min_width_px
    weighting: Weighting = CentroidSettings.weighting
    max_peaks: Room = CentroidSettings.max_peaks


@checked_dataclass(frozen=True, config=STRICT)
class FitSearch(CentroidSettings):
    """Search for the candidates of fits."""

    threshold_fraction: Fraction = _SEARCH.threshold_fraction
    detection_sigma: Sigmas = _SEARCH.detection_sigma
    min_width_px: Pixels = _SEARCH.min_width_px
    weighting: Weighting = _SEARCH.weighting
    max_peaks: Room = _SEARCH.max_peaks


@checked_dataclass(frozen=True, config=STRICT)
class FitMethod(FitSettings):
    """Weighted fit of lines integrated over the pixels, overlapping ones together.

    Lines are Gaussian where no `shape` is given. A bright line that is no Gaussian is better
    explained by several: further peaks are looked for only where a width is given, which says that
    the lines are Gaussian, or a shape, or where asked for. A shape has its width: `width_px` is
    not given with it, and `width_log_sigma`, 0 if left out, says how much it may be stretched.
    """

    method: Literal["fit"] = "fit"
    search: FitSearch = field(default_factory=FitSearch)
    width_px: Annotated[
        float, Field(ge=_LOW_PX, le=_HIGH_PX, description="Standard deviation of the lines [px].")
    ] = FitSettings.width_px
    width_log_sigma: Annotated[
        float,
        Field(
            ge=0.0,
            le=WIDEST_SPREAD,
            description="Deviation of the width's logarithm. 0: the width is known; 1e-6 or more "
            "otherwise; from 10 on next to nothing is known.",
        ),
    ] = FitSettings.width_log_sigma
    reach: Annotated[float, Field(ge=2.0, le=8.0)] = FitSettings.reach
    background: BackgroundModel = FitSettings.background
    shape_error: Annotated[float, Field(ge=0.0, le=0.5)] = FitSettings.shape_error
    max_joint_peaks: Annotated[int, Field(ge=1, le=MAX_JOINT_PEAKS)] = FitSettings.max_joint_peaks
    false_split_rate: Annotated[float, Field(ge=1e-12, le=0.1)] = FitSettings.false_split_rate
    further_peaks: Annotated[
        bool,
        Field(
            description="Where a line's shape does not explain the pixels, more peaks are tried. "
            "Left out: true where `width_px` or `shape` is given, and else false, as bright lines "
            "that are not Gaussian would be split."
        ),
    ] = False
    shape: Annotated[
        Shape | None,
        Field(description="How lines are spread, where that is known; null: Gaussian."),
    ] = None

    @model_validator(mode="before")
    @classmethod
    def _further_peaks(cls, given: Any) -> Any:
        if isinstance(given, ArgsKwargs):
            return ArgsKwargs(given.args, cls._completed(given.kwargs or {}))
        return cls._completed(given) if isinstance(given, dict) else given

    @staticmethod
    def _completed(given: dict[str, Any]) -> dict[str, Any]:
        if given.get("shape") is None:
            return {"further_peaks": "width_px" in given, **given}
        if "width_px" in given:
            raise InvalidParameter(
                "method.width_px is given with shape, which has a width; leave it out"
            )
        return {"further_peaks": True, "width_log_sigma": 0.0, **given}

    @property
    def settings(self) -> FitSettings:
        """Compute's settings, with the width that a shape has; raises InvalidParameter."""
        plain = {one.name: getattr(self, one.name) for one in fields(FitSettings)}
        if self.shape is not None:
            plain["width_px"] = self.shape.width_px
        return FitSettings(**plain)

    @property
    def line_shape(self) -> LineSpreadFunction | None:
        """Compute's shape; None: a Gaussian.

        Raises:
            InvalidParameter: a shape that cannot be used.
        """
        return None if self.shape is None else self.shape.line_shape


@checked_dataclass(frozen=True, config=STRICT)
class MatchedMethod(DetectionSettings):
    """Matched filter at a chosen rate of false alarms: faint peaks, to the pixel only."""

    method: Literal["matched"] = "matched"
    false_alarms_per_line: Annotated[float, Field(gt=0.0, le=MAX_PIXELS)] = (
        DetectionSettings.false_alarms_per_line
    )
    noise: NoiseSource = DetectionSettings.noise
    max_peaks: Room = DetectionSettings.max_peaks
    width_px: Annotated[
        float, Field(ge=0.2, le=_WIDEST_PX, description="Standard deviation of the lines [px].")
    ] = FitSettings.width_px
    length_px: Annotated[
        int | None,
        Field(
            ge=3,
            le=_LONGEST_PX,
            description="Pixels of the filter, odd, four widths and one or more; null: sixteen.",
        ),
    ] = None


Method = Annotated[
    CentroidMethod | FitMethod | ChainMethod | MatchedMethod | MaskMethod,
    Field(discriminator="method"),
]
