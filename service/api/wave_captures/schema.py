"""Wave captures as clients send and receive them."""

from typing import Annotated, Final, Literal

from pydantic import Field

from compute.calibration.bundle_adjustment.target_shape import KnownDistance
from compute.calibration.self_calibration.targets import (
    CalibrationTarget,
    RigidBody,
    UnknownRigidBody,
    Wand,
)
from hardware.field_bounds import FIRST_ERROR_ONLY
from service.api.base_models import Position, RequestModel, ResponseModel
from service.api.captures.schema import CaptureSession, Marker, NewCaptureSession

MAX_POSES: Final = 5_000
MAX_MARKERS: Final = 64

Length = Annotated[float, Field(gt=0, le=1e6, description="[mm]")]
Deviation = Annotated[float, Field(ge=0, le=1e3, description="[mm]")]


class WandTarget(RequestModel):
    """Markers on a line at known places."""

    kind: Literal["wand"]
    position_mm: Annotated[
        list[Annotated[float, Field(ge=-1e6, le=1e6)]],
        Field(max_length=MAX_MARKERS, description="Of the markers along the wand [mm]."),
        FIRST_ERROR_ONLY,
    ]
    sigma_mm: Deviation = 0.0


class BodyTarget(RequestModel):
    """A rigid body, or calibration frame, of known shape."""

    kind: Literal["rigid-body"]
    marker_mm: Annotated[list[Position], Field(max_length=MAX_MARKERS), FIRST_ERROR_ONLY]
    sigma_mm: Deviation = 0.0


class UnknownTarget(RequestModel):
    """A rigid body of unknown shape, with one known distance for the scale."""

    kind: Literal["unknown-body"]
    markers: Annotated[int, Field(ge=1, le=MAX_MARKERS)]
    first: Annotated[int, Field(ge=1, le=MAX_MARKERS, description="Marker, counted from 1.")]
    second: Annotated[int, Field(ge=1, le=MAX_MARKERS, description="Marker, counted from 1.")]
    length_mm: Length
    sigma_mm: Deviation = 0.0


MovedTarget = Annotated[WandTarget | BodyTarget | UnknownTarget, Field(discriminator="kind")]


def calibration_target(target: WandTarget | BodyTarget | UnknownTarget) -> CalibrationTarget:
    """Return a target for the computation; raises InvalidParameter where it can be none."""
    if isinstance(target, WandTarget):
        return Wand(tuple(target.position_mm), target.sigma_mm)
    if isinstance(target, BodyTarget):
        return RigidBody(tuple(target.marker_mm), target.sigma_mm)
    distance = KnownDistance(target.first - 1, target.second - 1, target.length_mm, target.sigma_mm)
    return UnknownRigidBody(target.markers, distance)


class WaveSettings(RequestModel):
    """When the taking of poses ends."""

    duration_s: Annotated[float, Field(gt=0, le=3600)] = Field(
        default=180.0, description="At the latest, after each start."
    )
    end_when_enough: bool = Field(default=True, description="As soon as nothing is missing.")


class NewWaveCapture(NewCaptureSession):
    """A session to begin, in which a wand or rigid body is waved in front of a running device."""

    target: MovedTarget
    markers: (
        Annotated[list[Marker], Field(min_length=1, max_length=MAX_MARKERS), FIRST_ERROR_ONLY]
        | None
    ) = Field(
        default=None,
        description="Strobed marker of each of the target's markers, in its order; null: 0, 1, ... "
        "Markers that are lit together cannot be told apart.",
    )
    settings: WaveSettings = Field(default_factory=WaveSettings)


class WaveExposures(ResponseModel):
    """Exposures of the target's first marker, counted by whether they gave a pose."""

    all: int = Field(description="All of them.")
    taken: int = Field(description="Poses taken.")
    still: int = Field(description="The target had hardly moved since the pose before.")
    too_few_sensors: int = Field(description="A marker was read by fewer than three sensors.")
    not_lit: int = Field(description="Exposures of another marker were lost before or after it.")


class WaveSensor(ResponseModel):
    """Coverage of one sensor by readings of the target."""

    sensor: str
    clear: int = Field(description="Exposures of the target's markers with a clear peak.")
    unclear: int = Field(
        description="With a peak that is saturated, clipped, merged with another or ambiguous."
    )
    unseen: int = Field(description="Without any peak.")
    readings: int = Field(description="Readings in the poses taken.")
    cells: list[int] = Field(description="Readings in equal parts of its pixels.")
    wanted: int = Field(description="Readings that a part must have to count.")
    covered: float = Field(ge=0, le=1, description="Share of these parts that have enough.")


class WaveDirections(ResponseModel):
    """Directions of the wand in the device's frame: z towards the sensors, x along the pixels of
    the first sensor.
    """

    rms: tuple[float, float, float] = Field(
        description="RMS of the components along x, y, z; 0.58 each is all round."
    )
    rings: list[int] = Field(
        description="Number of bins in the cap about z and in each ring, of equal solid angle."
    )
    bins: list[int] = Field(
        description="Poses in the bins of the half sphere z >= 0: the cap, then ring by ring, each "
        "from x to y."
    )
    wanted: int = Field(description="Poses that a bin must have to count.")


class WaveVolume(ResponseModel):
    """Volume that the target was in, in the device's frame."""

    extent_mm: tuple[float, float, float] = Field(description="Along x, y, z [mm].")
    octants: list[int] = Field(description="Poses in the eighths of the volume, x first, z last.")


class WaveProgress(ResponseModel):
    """Coverage of a wave so far, and what is missing."""

    poses: int = Field(description="Poses that show enough of the target to enough sensors.")
    wanted_poses: int = Field(description="Poses that are enough where they cover everything.")
    exposures: WaveExposures = Field(description="Which made poses, and why others did not.")
    sensors: list[WaveSensor]
    directions: WaveDirections | None = Field(description="Null: no cameras yet to judge by.")
    volume: WaveVolume | None = Field(description="Null: no cameras yet to judge by.")
    missing: list[str] = Field(description="What is missing, in sentences.")
    enough: bool = Field(description="Whether nothing is missing.")


WaveState = Literal["ready", "capturing", "stopped"]


class WaveCapture(CaptureSession):
    """A session: what has been covered, what is missing, what to do next."""

    target: MovedTarget
    markers: list[int]
    settings: WaveSettings
    state: WaveState
    ended: str | None = Field(description="Why the taking of poses ended; null: it has not.")
    progress: WaveProgress = Field(description="What is covered, and what is missing.")
