"""Tools, their poses and calibrations as clients send and receive them."""

from typing import Annotated, Literal

from pydantic import Field

from compute.pose.rigid_body import PoseStatus
from hardware.field_bounds import FIRST_ERROR_ONLY
from service.api.base_models import (
    Moment,
    Note,
    Position,
    RequestModel,
    ResponseModel,
    Slug,
    Text200,
    absent,
)

MIN_MARKERS = 3
MAX_MARKERS = 64
TRACKER = "tracker"
"""The device's world, as a frame; no tool and no registration is called so."""

Marker = Annotated[int, Field(ge=0, le=65535)]
Matrix3 = tuple[Position, Position, Position]
Row6 = tuple[float, float, float, float, float, float]
Matrix6 = tuple[Row6, Row6, Row6, Row6, Row6, Row6]


class ToolLimits(RequestModel):
    """When a pose is not good enough to be used."""

    tip_sd_mm: Annotated[float, Field(gt=0, le=1e4)] | None = Field(
        default=None,
        description="Standard deviation of the tip in space above which a pose is HIGH_ERROR; "
        "null: as the device's `tracking` says.",
    )


class _Described(RequestModel):
    id: Slug = Field(
        description="Unique among all tools and registrations; also the name of the tool's frame. "
        f"Not `{TRACKER}`, which is the device's own."
    )
    device_id: Slug
    title: Text200
    tip_mm: Position | None = Field(
        default=None,
        description="The working point in the tool's coordinates; null: its origin.",
    )
    reference_id: Slug | None = Field(
        default=None,
        description="The tool of the same device that poses are given relative to, such as one "
        "that is fixed to the patient; null: the tracker.",
    )
    limits: ToolLimits = Field(default_factory=ToolLimits)
    note: Note = ""


class NewTool(_Described):
    """A tool to create, of known geometry."""

    markers_mm: Annotated[
        list[Position], Field(min_length=MIN_MARKERS, max_length=MAX_MARKERS), FIRST_ERROR_ONLY
    ] = Field(description="Its markers in its own coordinates.")
    strobe_markers: (
        Annotated[
            list[Marker], Field(min_length=MIN_MARKERS, max_length=MAX_MARKERS), FIRST_ERROR_ONLY
        ]
        | None
    ) = Field(
        default=None,
        description="The number of each marker's strobe slot, in the same "
        "order; null: they are lit together, and told by their geometry.",
    )


class NewCapturedTool(_Described):
    """A tool to define from what a running device sees of it, held still."""

    strobe_markers: (
        Annotated[
            list[Marker], Field(min_length=MIN_MARKERS, max_length=MAX_MARKERS), FIRST_ERROR_ONLY
        ]
        | None
    ) = Field(default=None, description="Its strobed markers; null: all are lit together.")
    markers: Annotated[int, Field(ge=MIN_MARKERS, le=MAX_MARKERS)] | None = Field(
        default=None,
        description="How many markers it has, and are in view, when they are lit together.",
    )
    duration_s: float = Field(default=1.0, gt=0, le=60, description="How long it is looked at.")
    tip_mm: Position | None = Field(
        default=None, description="The working point in the coordinates that it will have."
    )


class ToolChange(RequestModel):
    """Changes of a tool; a field left out stays as it is. Its geometry never changes."""

    title: Text200 = absent()
    tip_mm: Position | None = Field(default=None, description="null: its origin.")
    reference_id: Slug | None = Field(default=None, description="null: the tracker.")
    limits: ToolLimits = absent()
    note: Note = absent()


class Tip(ResponseModel):
    """Working point of a tool, and where it is known from."""

    position_mm: Position | None = Field(description="null: not known; poses take the origin.")
    covariance_mm2: Matrix3 | None = Field(
        default=None, description="null: not known, taken as exact."
    )
    tool_calibration_id: str | None = Field(
        default=None, description="The pivot calibration that it is from; null: it was given."
    )
    axis: Position | None = Field(
        default=None, description="Direction of the tool's long axis, from a spin calibration."
    )


class Origin(ResponseModel):
    """Origin of a tool's geometry: given, or captured."""

    kind: Literal["given", "captured"]
    frames: int | None = Field(default=None, description="Exposures that a capture averaged.")
    sigma_mm: list[float] | None = Field(
        default=None,
        description="Standard deviation in space of each captured marker's place [mm].",
    )
    calibration_id: str | None = Field(default=None, description="Active during the capture.")
    table_id: str | None = Field(
        default=None, description="The correction table that was active with it; null: none."
    )


class Tool(ResponseModel):
    """A tool."""

    id: str
    device_id: str
    title: str
    markers_mm: list[Position]
    strobe_markers: list[int] | None
    tip: Tip
    reference_id: str | None
    limits: ToolLimits
    origin: Origin
    note: str
    created_at: Moment
    updated_at: Moment


class Pose(ResponseModel):
    """The newest pose of a tool, or why there is none."""

    tool_id: str
    device_id: str
    frame_id: str = Field(
        description=f"What it is relative to: `{TRACKER}`, a tool, or a registration."
    )
    status: PoseStatus = Field(description="Only a pose that is OK is one to use.")
    reason: str | None = Field(description="Why the status is not OK, in words.")
    exposure_ns: int | None = Field(
        description="Middle of the exposure on the host's clock, since 1970 UTC."
    )
    sequence: int | None = Field(description="Number of the frame.")
    age_s: float | None = Field(description="Since the exposure, when this was answered.")
    calibration_id: str | None = Field(
        description="The calibration that was active for this frame."
    )
    table_id: str | None = Field(description="The correction table active with it; null: none.")
    translation_mm: Position | None = Field(description="The tool's origin in the frame.")
    rotation: Matrix3 | None = Field(description="R_frame_tool, row by row.")
    quaternion_wxyz: tuple[float, float, float, float] | None = Field(
        description="The same turn as a unit quaternion, w >= 0."
    )
    matrix: tuple[tuple[float, float, float, float], ...] | None = Field(
        description="T_frame_tool, 4 x 4, row by row."
    )
    covariance: Matrix6 | None = Field(
        description="Of a small turn [rad] about the frame's axes, on the left, and of the "
        "translation [mm], in this order."
    )
    tip_mm: Position | None = Field(description="The tip in the frame.")
    tip_covariance_mm2: Matrix3 | None
    residual_sigma: float | None = Field(
        description="Root of chi2 per degree of freedom of the readings, about 1."
    )
    markers_used: int
    readings_used: int
    detectable_sigma: float | None = Field(
        description="Error of one of the tool's readings, in its standard deviations, from which "
        "on it is found with a probability of 0.8, whichever reading it is; null: not known, or "
        "nothing checks some reading."
    )
    external_tip_mm: float | None = Field(
        description="Largest shift of the tip by an error of that size in one reading; null "
        "likewise. Of the tool's own pose, also relative to another tool."
    )
    external_rotation_rad: float | None = Field(description="The same of its rotation.")


class NewToolCalibration(RequestModel):
    """Request of a pivot or spin calibration from live poses."""

    duration_s: float = Field(
        default=10.0, gt=0, le=120, description="How long poses are collected."
    )
    poses: Annotated[int, Field(ge=10, le=5000)] = Field(
        default=500, description="Poses that are used at most, evenly from all of that time."
    )
    min_swing_deg: Annotated[float, Field(gt=0, le=60)] | None = Field(
        default=None,
        description="RMS angle by which each direction of the tool must swing at least, of a spin "
        "those across the axis; null: 5 of a pivot, 20 of a spin.",
    )
    relative: bool = Field(
        default=True,
        description="Whether poses relative to the tool's reference are taken, where it has one: "
        "then what holds the fixed point may move with it.",
    )
    apply: bool = Field(
        default=True, description="Whether the tool is given what was found, at once."
    )


class ToolCalibration(ResponseModel):
    """A pivot or spin calibration and its results."""

    id: str
    tool_id: str
    device_id: str
    kind: Literal["pivot", "spin"]
    applied: bool
    poses: int = Field(description="Poses that were used.")
    outliers: int = Field(description="Poses that did not fit the others and were left out.")
    tip_mm: Position | None = Field(description="Of a pivot calibration.")
    tip_covariance_mm2: Matrix3 | None
    axis: Position | None = Field(description="Direction, of a spin calibration.")
    point_mm: Position | None = Field(description="A point of the axis, of a spin calibration.")
    rms_mm: float = Field(
        description="RMS distance of the tip from the fixed point, or of the point from the axis."
    )
    residual_sigma: float | None = Field(
        description="Root of chi2 per degree of freedom, about 1 where the poses' covariances are "
        "right."
    )
    smallest_rotation_deg: float = Field(
        description="RMS angle by which the tool swung where it did least."
    )
    calibration_id: str | None = Field(
        default=None, description="Active while poses were collected; null: not kept."
    )
    table_id: str | None = Field(
        default=None, description="The correction table that was active with it; null: none."
    )
    request: NewToolCalibration
    created_at: Moment
