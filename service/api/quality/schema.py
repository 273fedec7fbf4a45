"""Quality checks and the drift watch as clients send and receive them."""

from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Field, RootModel, model_validator

from compute.quality.accuracy import PointToPoint, SinglePoint
from service.api.base_models import Moment, Note, Position, RequestModel, ResponseModel, Slug

MAX_SECONDS = 60.0
MarkerNumber = Annotated[int, Field(ge=0, le=10_000)]
Millimetres = Annotated[float, Field(gt=0, le=1e5)]


class _Asked(RequestModel):
    id: Slug | None = Field(default=None, description="Left out or null: the server makes one.")
    duration_s: Annotated[float, Field(ge=0.5, le=MAX_SECONDS)] = Field(
        default=10.0, description="How long is measured; the answer comes after that."
    )
    tolerance_mm: Millimetres | None = Field(
        default=None, description="95 % of the errors must be smaller for the check to be passed."
    )
    note: Note = ""


class NewSinglePoint(_Asked):
    """A marker that stands still is measured again and again."""

    kind: Literal["single-point"]
    marker: MarkerNumber | None = Field(
        default=None, description="The strobed marker; null: all are lit, and one is in view."
    )
    reference_position_mm: Position | None = Field(
        default=None, description="Where it is; null: not known, and only its scatter is measured."
    )


class NewPointToPoint(_Asked):
    """The known distance of two markers is measured while they are carried through the volume."""

    kind: Literal["point-to-point"]
    markers: tuple[MarkerNumber, MarkerNumber] | None = Field(
        default=None, description="The strobed markers; null: all are lit, and two are in view."
    )
    reference_mm: Millimetres = Field(description="Their distance.")
    reference_sigma_mm: Annotated[float, Field(ge=0, le=1000)] = Field(
        default=0.0, description="Its standard deviation."
    )

    @model_validator(mode="after")
    def _two(self) -> "NewPointToPoint":
        if self.markers is not None and self.markers[0] == self.markers[1]:
            raise ValueError(
                f"markers names marker {self.markers[0]} twice; a distance is between two"
            )
        return self


class NewQualityCheck(
    RootModel[Annotated[NewSinglePoint | NewPointToPoint, Field(discriminator="kind")]]
):
    """A quality check to make."""

    model_config = ConfigDict(frozen=True)


class QualityCheck(ResponseModel):
    """Result of a quality check."""

    id: str
    device_id: str
    kind: Literal["single-point", "point-to-point"]
    calibration_id: str = Field(description="What the points were made with.")
    table_id: str | None
    asked: dict[str, Any] = Field(description="The request's own members.")
    result: SinglePoint | PointToPoint
    passed: bool | None = Field(description="Against `tolerance_mm`; null without one.")
    points: int = Field(description="Points, or pairs, that were used.")
    left_out: int = Field(description="Those without a position or covariance, or ambiguous.")
    temperature_c: float | None = Field(description="Of the device, where it reports one.")
    note: str
    created_at: Moment


class ReferenceMarker(RequestModel):
    """A strobed marker that is fixed to where the device stands."""

    marker: MarkerNumber


class WatchSettings(RequestModel):
    """Settings of watching a device's drift."""

    interval_s: Annotated[float, Field(ge=10, le=86400)] = Field(
        default=600.0, description="How much time one value of the charts sums up."
    )
    reference: ReferenceMarker | None = Field(
        default=None, description="A strobed marker that never moves; null: there is none."
    )


class WatchSample(ResponseModel):
    """Statistics of a running device over one interval."""

    device_id: str
    calibration_id: str
    table_id: str | None
    measured_at: Moment = Field(description="Its end.")
    duration_s: float
    points: int
    residual_sigma: float | None = Field(
        description="Root of the mean square residual of points with four or more sensors, in "
        "standard deviations: about 1 while the calibration holds; null: there were none."
    )
    inconsistent: int = Field(description="Points whose readings contradict one another.")
    reference_mm: tuple[float, float, float] | None = Field(
        description="Where the reference marker was on average."
    )
    reference_scatter_mm: float | None = Field(description="Its scatter about that, RMS.")
    temperature_c: float | None


class ChartPoint(ResponseModel):
    """One value of a control chart."""

    measured_at: Moment
    value: float
    average: float = Field(description="Exponentially weighted, with the values before.")
    signal: Literal["none", "jump", "drift"]


class Chart(ResponseModel):
    """A control chart: values over time and the limits that they keep while nothing changes."""

    series: str
    meaning: str
    unit: str
    ready: bool = Field(description="Whether there are enough values to say what is normal.")
    baseline: int = Field(description="Values that this is taken from.")
    centre: float | None
    lower: float | None
    upper: float | None
    points: list[ChartPoint]


class Quality(ResponseModel):
    """Quality of a device with its active calibration, and the recommended action."""

    device_id: str
    calibration_id: str | None
    table_id: str | None
    watch: WatchSettings
    recommendation: Literal["none", "observe", "check", "recalibrate"] = Field(
        description="`none`: nothing is amiss. `observe`: not enough is known yet. `check`: "
        "something changed; make a drift check. `recalibrate`: it stays changed, or a check failed."
    )
    reasons: list[str]
    charts: list[Chart]
