"""Capture sessions as clients send and receive them."""

from typing import Annotated

from pydantic import Field, StringConstraints

from hardware.field_bounds import FIRST_ERROR_ONLY
from service.api.base_models import (
    Moment,
    Name,
    Note,
    Position,
    RequestModel,
    ResponseModel,
    Slug,
)
from service.api.devices.schema import RECORDING_PATTERN

MAX_TARGETS = 2_000


Marker = Annotated[int, Field(ge=0, le=65535)]


class Target(RequestModel):
    """A named place at which a marker will be held, or has its own."""

    name: Name
    position_mm: Position = Field(description="X, Y, Z in the world frame [mm].")
    marker: Marker | None = Field(
        default=None,
        description="Strobed marker at this target, of a frame with many; null: the settings'.",
    )


class CaptureSettings(RequestModel):
    """How each target is captured."""

    frames: int = Field(default=50, ge=3, le=10_000, description="Frames that are averaged.")
    marker: Marker | None = Field(
        default=None,
        description="Strobed marker to take at targets that name none; null: frames in which "
        "each sensor sees one peak.",
    )
    seen_share: Annotated[float, Field(ge=0.1, le=1)] = Field(
        default=0.8, description="Share of the frames in which a sensor must see the marker."
    )
    timeout_s: Annotated[float, Field(gt=0, le=60)] = Field(
        default=10.0, description="How long the frames are waited for."
    )
    still_px: Annotated[float, Field(ge=0.001, le=1000)] = Field(
        default=0.5,
        description="With `recording_id`: largest change of a reading within a still period [px].",
    )


class NewCaptureSession(RequestModel):
    """What sessions of all kinds of captures begin with."""

    id: Slug | None = Field(default=None, description="Left out or null: the server makes one.")
    device_id: Slug
    note: Note = ""


class NewCapture(NewCaptureSession):
    """A capture session to begin."""

    targets: Annotated[list[Target], Field(min_length=1, max_length=MAX_TARGETS), FIRST_ERROR_ONLY]
    recording_id: (
        Annotated[str, StringConstraints(max_length=200, pattern=RECORDING_PATTERN)] | None
    ) = Field(
        default=None,
        description="A recording with scans of the device: all targets are captured from it. Those "
        "with a strobed marker rest all the time; those without are its still periods of ten "
        "exposures or more, in their order. Null: from the running device, one by one.",
    )
    settings: CaptureSettings = Field(default_factory=CaptureSettings)


class CapturedSensor(ResponseModel):
    """What one sensor read of a target."""

    sensor: str
    frames: int = Field(description="Frames in which it saw one clear peak.")
    mean_px: float
    spread_px: float = Field(description="Standard deviation of one frame's reading.")
    stated_px: float | None = Field(
        description="What the peaks' own deviations let expect of it; null: they have none."
    )
    sigma_px: float = Field(description="Standard deviation of the mean.")


class Captured(ResponseModel):
    """What each capture of a session has."""

    frames: int = Field(description="Frames that it was made of.")
    captured_at: Moment


class CapturedTarget(Captured):
    """What was read of a target."""

    target: str
    sensors: list[CapturedSensor] = Field(description="Those that saw it.")


class CaptureSession(ResponseModel):
    """What sessions of all kinds of captures have: how far they are, and what to do next."""

    id: str
    device_id: str
    instruction: str = Field(description="What to do now.")
    left: int = Field(description="Captures that are left.")
    note: str
    created_at: Moment
    updated_at: Moment


class Capture(CaptureSession):
    """A capture session: what is done and what is left."""

    recording_id: str | None = Field(description="Captured from it; null: from the device.")
    settings: CaptureSettings
    targets: list[Target]
    captured: list[CapturedTarget] = Field(description="In the order of the targets.")
    next: str | None = Field(description="The next target; null: all are captured.")
