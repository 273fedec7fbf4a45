"""Beam holds as clients send and receive them."""

from typing import Annotated, Literal

from pydantic import Field

from compute.pose.beam_hold import BeamHoldCause, BeamHoldLimits, BeamHoldTiming
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
from service.api.tools.schema import Marker, Matrix3, Matrix6

MAX_MARKERS = 32
_LIMITS = BeamHoldLimits(shift_mm=1.0)
_RULES = BeamHoldTiming()

Length = Annotated[float, Field(gt=0, le=1e4)]
Shift = Annotated[float, Field(gt=0, le=100)]
"""Of a patient [mm]; more is a slip of the unit."""
ShiftLimit = Annotated[
    Shift | None, Field(description="Distance of the target, or of each marker, from its place.")
]
AxisLimits = Annotated[
    tuple[Shift, Shift, Shift] | None, Field(description="Shift along each axis.")
]
RotationLimit = Annotated[
    Annotated[float, Field(gt=0, le=3.2)] | None, Field(description="Turn, of a tool.")
]
Probability = Annotated[
    float,
    Field(
        gt=0,
        le=0.5,
        description="The beam is held when the probability of being beyond a limit is above this. "
        "0.5 leaves uncertainty aside; less holds sooner.",
    ),
]
ReleaseFraction = Annotated[
    float,
    Field(
        gt=0,
        le=1,
        description="Share of the limits within which, by the same probability, a hold may end.",
    ),
]
MaxGap = Annotated[
    float,
    Field(
        ge=1e-3,
        le=10,
        description="Longest time without a measurement before the beam is held: for so long a "
        "movement may go unseen.",
    ),
]
SettlingTime = Annotated[
    float,
    Field(
        ge=0,
        le=600,
        description="How long all has to be within the release limits before the beam goes on.",
    ),
]
Latched = Annotated[
    bool,
    Field(description="Whether a hold, after the first release, lasts until it is acknowledged."),
]
MarkerCount = Annotated[int, Field(ge=1, le=MAX_MARKERS)]
MinMarkers = Annotated[
    MarkerCount | None,
    Field(description="With fewer of them seen, nothing counts as measured; null: all of them."),
]


class ToolWatch(RequestModel):
    """A tool that is fixed to the patient, by its pose."""

    kind: Literal["tool"]
    tool_id: Slug
    target_mm: Position = Field(
        default=(0.0, 0.0, 0.0),
        description="The point to be irradiated, in the tool's coordinates.",
    )
    axes: Matrix3 | None = Field(
        default=None,
        description="Directions of the axes of `axis_mm` and of the shifts told, in the device's "
        "world, row by row: those of the treatment room. null: the world's.",
    )


class StrobedMarkersWatch(RequestModel):
    """Strobed markers on the patient, each by its number."""

    kind: Literal["strobed-markers"]
    markers: Annotated[list[Marker], Field(min_length=1, max_length=MAX_MARKERS), FIRST_ERROR_ONLY]
    min_markers: MinMarkers = None


class SimultaneousMarkersWatch(RequestModel):
    """Markers on the patient that are lit together, each near its place."""

    kind: Literal["simultaneous-markers"]
    markers: MarkerCount = Field(description="How many.")
    min_markers: MinMarkers = None
    search_radius_mm: Length = Field(
        default=30.0,
        description="How far from its place a marker is looked for; farther than the limits.",
    )
    observed_as: Literal["points", "tracks"] = Field(
        default="points",
        description="The points of each frame, which need four sensors, or tracks, which the "
        "device then follows.",
    )


Watch = Annotated[
    ToolWatch | StrobedMarkersWatch | SimultaneousMarkersWatch, Field(discriminator="kind")
]


class Limits(RequestModel):
    """Largest motion from the reference; at least one of the first three is needed."""

    shift_mm: ShiftLimit = None
    axis_mm: AxisLimits = None
    rotation_rad: RotationLimit = None
    probability: Probability = _LIMITS.probability
    release: ReleaseFraction = _LIMITS.release_fraction


class Rules(RequestModel):
    """Timing rules of the begin and end of a beam hold."""

    max_gap_s: MaxGap = _RULES.max_gap_ns * 1e-9
    settle_s: SettlingTime = _RULES.settle_ns * 1e-9
    latched: Latched = _RULES.latched


class LimitsChange(RequestModel):
    """Limits to change; one left out stays as it is, null takes it away."""

    shift_mm: ShiftLimit = absent()
    axis_mm: AxisLimits = absent()
    rotation_rad: RotationLimit = absent()
    probability: Probability = absent()
    release: ReleaseFraction = absent()


class RulesChange(RequestModel):
    """Rules to change; one left out stays as it is."""

    max_gap_s: MaxGap = absent()
    settle_s: SettlingTime = absent()
    latched: Latched = absent()


class ReferenceInput(RequestModel):
    """Reference from elsewhere: a tool's pose, or the positions of markers."""

    rotation: Matrix3 | None = Field(default=None, description="R_world_tool, row by row.")
    translation_mm: Position | None = Field(
        default=None, description="The tool's origin in the device's world."
    )
    covariance: Matrix6 | None = Field(
        default=None,
        description="Of a small turn [rad] about the world's axes, on the left, and of the "
        "translation [mm]; null: exact.",
    )
    positions_mm: (
        Annotated[list[Position], Field(min_length=1, max_length=MAX_MARKERS), FIRST_ERROR_ONLY]
        | None
    ) = Field(default=None, description="Of markers in the device's world, in their order.")


class NewBeamHold(RequestModel):
    """A beam hold to create. It holds until it has a reference and all was near it."""

    id: Slug = Field(description="Unique among all holds.")
    device_id: Slug
    title: Text200
    watch: Watch
    limits: Limits
    rules: Rules = Field(default_factory=Rules)
    reference: ReferenceInput | None = Field(
        default=None, description="null: it is captured, or given, later."
    )
    note: Note = ""


class BeamHoldChange(RequestModel):
    """Changes of a beam hold; members left out stay. Its target never changes."""

    title: Text200 = absent()
    limits: LimitsChange = absent()
    rules: RulesChange = absent()
    note: Note = absent()


class NewReference(RequestModel):
    """Request of a reference: measured now, or given."""

    frames: Annotated[int, Field(ge=10, le=5000)] = Field(
        default=100,
        description="Frames that are averaged: of each strobed marker, or of the pose.",
    )
    timeout_s: Annotated[float, Field(gt=0, le=60)] = Field(
        default=10.0, description="How long they are waited for."
    )
    max_scatter_mm: Length = Field(
        default=0.5,
        description="Largest standard deviation in space of what is averaged; what moves more is "
        "no reference.",
    )
    given: ReferenceInput | None = Field(
        default=None, description="Taken as it is, and nothing is measured."
    )


class Reference(ResponseModel):
    """Reference of a beam hold: the pose or the positions at set-up."""

    id: str = Field(description="Another for each reference that was taken.")
    kind: Literal["given", "captured"]
    calibration_id: str | None = Field(
        description="Active then. With another calibration the reference is not used, and the beam "
        "is held; null: none was."
    )
    table_id: str | None = Field(description="The table active then; as `calibration_id`.")
    rotation: Matrix3 | None
    translation_mm: Position | None
    covariance: Matrix6 | None
    positions_mm: list[Position] | None
    covariances_mm2: list[Matrix3] | None
    frames: int | None = Field(description="That were averaged; null: it was given.")
    scatter_mm: float | None = Field(
        description="Largest standard deviation in space of what was averaged."
    )
    set_at: Moment


class BeamHold(ResponseModel):
    """A beam hold."""

    id: str
    device_id: str
    title: str
    watch: Watch
    limits: Limits
    rules: Rules
    reference: Reference | None = Field(description="null: there is none, and the beam is held.")
    note: str
    created_at: Moment
    updated_at: Moment


class BeamHoldStatus(ResponseModel):
    """State of a beam hold, with its cause."""

    hold_id: str
    device_id: str
    held: bool = Field(description="Only false lets the beam go on.")
    cause: BeamHoldCause
    reason: str | None = Field(description="The cause in words; null while it is not held.")
    since_ns: int = Field(
        description="When it began to be, or not to be, held, on the host's clock, since 1970 UTC."
    )
    exposure_ns: int | None = Field(
        description="Middle of the exposure of the newest frame that was looked at; null: none."
    )
    sequence: int | None = Field(description="Number of that frame.")
    shift_mm: Position | None = Field(
        description="Of the target, or of the marker nearest to its limit, in that frame."
    )
    rotation_rad: Position | None = Field(
        description="Rotation vector from the reference, of a tool."
    )
    probability: float | None = Field(
        description="Of being beyond the limit that is nearest to it; null: not measured."
    )
