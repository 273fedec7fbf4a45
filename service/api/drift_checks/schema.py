"""Still markers and drift checks as clients send and receive them."""

from typing import Annotated, Literal

from pydantic import Field

from compute.calibration.drift.drift_detection import DriftCheck
from hardware.field_bounds import FIRST_ERROR_ONLY
from service.api.base_models import Moment, Name, Note, Position, RequestModel, ResponseModel, Slug
from service.api.calibrations.schema import Readings

MAX_MARKERS = 200

Against = Literal["positions", "calibration", "capture"]
Verdict = Literal["good", "sensors-moved", "moved-as-a-whole", "off"]


class StationaryPoint(RequestModel):
    """A marker that stands still, and what the sensors read of it now."""

    name: Name
    position_mm: Position | None = Field(
        default=None,
        description="X, Y, Z in the world frame [mm]; needed `against` positions, else left alone.",
    )
    readings: Readings


class StationaryMarker(StationaryPoint):
    """A still marker as it is stored: with its earlier readings, where it has any."""

    earlier: Readings | None = None


class StationaryMarkersRequest(RequestModel):
    """Stationary markers measured again, and their references."""

    points: (
        Annotated[
            list[StationaryPoint], Field(min_length=1, max_length=MAX_MARKERS), FIRST_ERROR_ONLY
        ]
        | None
    ) = Field(default=None, description="Give these, or `capture_id`.")
    capture_id: Slug | None = Field(
        default=None, description="A capture session, in place of points."
    )
    allow_incomplete: bool = Field(
        default=False, description="Take a capture session of which targets are missing."
    )
    against: Against = Field(
        default="positions",
        description="`positions`: what the calibration expects of markers at known positions. "
        "`calibration`: what its own control points of the same names read when it was made, and "
        "`capture`: what the targets of an earlier session read, both for markers that have not "
        "moved since. These two are finer: what the calibration itself is wrong by drops out.",
    )
    earlier_capture_id: Slug | None = Field(
        default=None, description="The earlier session, `against` capture."
    )
    position_sigma_mm: Annotated[float, Field(ge=0, le=1000)] = Field(
        default=0.0, description="Standard deviation of each coordinate of the positions."
    )


class NewDriftCheck(StationaryMarkersRequest):
    """A drift check to make."""

    id: Slug | None = Field(default=None, description="Left out or null: the server makes one.")
    note: Note = ""


class DriftCheckSummary(ResponseModel):
    """A drift check and its findings."""

    id: str
    device_id: str
    calibration_id: str
    status: Verdict = Field(
        description="`good`: the markers read as the calibration expects, within its uncertainty. "
        "`sensors-moved`: those listed. `moved-as-a-whole`: the markers, or the device, as one "
        "rigid whole. `off`: they do not read as expected, and no single sensor stands out."
    )
    moved: list[str] = Field(description="Sensors that moved by themselves.")
    in_words: list[str]
    against: Against
    markers: int
    capture_id: str | None
    earlier_capture_id: str | None
    position_sigma_mm: float
    note: str
    created_at: Moment
    check: DriftCheck


class DriftCheckDocument(DriftCheckSummary):
    """A drift check, whole."""

    points: list[StationaryMarker]
