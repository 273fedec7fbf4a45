"""Points measured with a tool's tip, as clients ask for and receive them."""

from typing import Annotated

from pydantic import Field

from service.api.base_models import Name, Position, RequestModel, ResponseModel, Slug
from service.api.tools.schema import Matrix3


class NewPoint(RequestModel):
    """A point to measure: hold the tip on it."""

    name: Name | None = Field(default=None, description="Goes into the answer; of any use to you.")
    frame_id: Slug | None = Field(
        default=None,
        description="`tracker`, a tool, or a registration; null: the tool's reference, without "
        "one the tracker.",
    )
    duration_s: Annotated[float, Field(ge=0.05, le=10)] = Field(
        default=0.5, description="How long the tip has to be still."
    )
    max_sigma_mm: Annotated[float, Field(gt=0, le=100)] = Field(
        default=0.5, description="Largest standard deviation of its places in that time."
    )
    max_drift_mm: Annotated[float, Field(gt=0, le=100)] = Field(
        default=0.3,
        description="Largest movement from its begin to its end that noise does not explain.",
    )
    timeout_s: float = Field(default=30.0, gt=0, le=120, description="How long to wait for that.")


class MeasuredPoint(ResponseModel):
    """A point that a tip was held on; it is not kept."""

    name: str | None
    tool_id: str
    device_id: str
    frame_id: str = Field(description="That the place is in.")
    position_mm: Position = Field(
        description="The mean: `measured_mm` of a fiducial, or one of `points_mm` on a surface."
    )
    covariance_mm2: Matrix3 = Field(
        description="Of the mean, the tip's own included: `measured_covariance_mm2` of a fiducial."
    )
    sigma_mm: float = Field(description="Standard deviation of a single place.")
    drift_mm: float = Field(description="Movement from begin to end, by a straight line.")
    frames: int = Field(description="That were averaged.")
    first_ns: int = Field(description="Exposure of the first on the host's clock.")
    last_ns: int = Field(description="Of the last.")
    tool_calibration_id: str | None = Field(
        description="The pivot calibration that the tip is from; null: it was given."
    )
    calibration_id: str = Field(description="The calibration that was active meanwhile.")
    table_id: str | None = Field(description="The correction table active with it; null: none.")
