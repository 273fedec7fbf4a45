"""Calibrations as clients send and receive them."""

from typing import Annotated, Any, Final, Literal, get_args

from pydantic import Discriminator, Field, StringConstraints, Tag

from compute.calibration.assessment.assess import MAX_LEAVE_ONE_OUT_POINTS
from compute.calibration.result import AxisErrors, Calibration, Method
from compute.calibration.settings import (
    CalibrationSettings,
    LabelPolicy,
    Loss,
    Preset,
)
from compute.camera.field_distortion import Term
from compute.camera.model import Vector3
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
from service.api.calibrations.comparison import Comparison

MAX_POINTS = 10_000

State = Literal["active", "available", "retired"]
Provenance = Literal["fitted", "self-calibrated", "updated", "nominal"]


class Reading(RequestModel):
    """One reading with its standard deviation."""

    position_px: float = Field(description="Peak position; 0 is the centre of the first pixel.")
    sigma_px: float = Field(ge=1e-6, le=1e4, description="Its standard deviation.")


def _reading_kind(value: Any) -> str:
    return "with-deviation" if isinstance(value, dict | Reading) else "position"


ReadingValue = Annotated[
    Annotated[float, Tag("position")] | Annotated[Reading, Tag("with-deviation")],
    Discriminator(_reading_kind),
]
# Without a pattern, which JSON schema would apply to the values only, not to other keys; a name
# that no sensor has is refused anyway.
SensorName = Annotated[str, StringConstraints(min_length=1, max_length=64)]
Readings = Annotated[
    dict[SensorName, ReadingValue],
    Field(
        max_length=64,
        description="By sensor: the peak's position [px], or it and its standard deviation. "
        "Leave out sensors that did not see the point.",
    ),
]


_SETS: Final = ("none", "auto", *get_args(Preset))


def _distortion_kind(value: Any) -> str | None:
    if isinstance(value, list | tuple):
        return "terms"
    return "set" if value in _SETS else None


# One message for what is neither, where a plain union has one of each member's.
GivenDistortion = Annotated[
    Annotated[Literal["none", "auto", Preset], Tag("set")]
    | Annotated[tuple[Term, ...], FIRST_ERROR_ONLY, Tag("terms")],
    Discriminator(
        _distortion_kind,
        custom_error_type="unknown_distortion",
        custom_error_message=f"Input should be one of {', '.join(_SETS)}, or terms u^i v^j as "
        "pairs of powers such as [[3, 0], [1, 2]]",
    ),
]


class ControlPoint(RequestModel):
    """A point of known position and what the sensors read of it."""

    name: Name
    position_mm: Position = Field(description="X, Y, Z in the world frame [mm].")
    readings: Readings


class CalibrationOptions(RequestModel):
    """Settings of a calibration, as clients give them."""

    distortion: GivenDistortion = Field(
        default="auto",
        description="Terms of the lens's distortion: `none`, `auto` (all terms up to the fifth "
        "order, their scale estimated from the readings of all sensors), the name of a set, or the "
        "terms themselves as pairs of powers of the two field angles.",
    )
    position_sigma_mm: Annotated[float, Field(ge=1e-6, le=1e3)] | None = Field(
        default=None,
        description="Standard deviation of each coordinate of the control points; null: exact.",
    )
    loss: Loss = Field(default="linear", description="`robust`: wrong readings lose their weight.")
    labels: LabelPolicy = Field(
        default="report",
        description="What is done with exchanged and wrong labels and with outliers: not looked "
        "for, reported, left out, or repaired (outliers: left out).",
    )

    def settings(self) -> CalibrationSettings:
        """Return them for the computation.

        Raises:
            InvalidParameter: one means nothing, or contradicts another.
        """
        return CalibrationSettings(self.distortion, self.position_sigma_mm, self.loss, self.labels)


class NewCalibration(CalibrationOptions):
    """Control points from which a device is calibrated."""

    id: Slug | None = Field(default=None, description="Left out or null: the server makes one.")
    device_id: Slug
    points: Annotated[list[ControlPoint], Field(max_length=MAX_POINTS), FIRST_ERROR_ONLY]
    note: Note = ""


class NewNominalCalibration(RequestModel):
    """The device whose profile gives a calibration."""

    id: Slug | None = Field(
        default=None,
        description="Left out or null: `<device_id>-nominal`, or where it is used, with the first "
        "free number: `-nominal-2`.",
    )
    device_id: Slug


class PointErrors(ResponseModel):
    """Differences between given and reconstructed control points."""

    statistics: AxisErrors | None = Field(description="Null when no point was reconstructed.")
    differences_mm: list[Vector3 | None] = Field(
        description="Reconstructed minus given, in the order of the points; null: no position."
    )
    readings: int | None = Field(
        default=None,
        description="How many readings the statistics rest on: those that the calibration used, "
        "with labels repaired or left out and without outliers that a robust loss gave no weight. "
        "Null in documents from before it was counted.",
    )


class LengthErrors(ResponseModel):
    """Known lengths of a waved target as they were measured at poses that the cameras never saw."""

    poses: int = Field(description="Poses that were held out, each once.")
    lengths: int = Field(description="Lengths measured at them.")
    rms_mm: float = Field(description="RMS of measured minus known lengths.")
    mean_mm: float = Field(description="Their mean: an error of scale.")
    max_mm: float = Field(description="The largest, without its sign.")


class ControlPointErrors(ResponseModel):
    """Errors of a calibration at its control points, or of the lengths of a waved target."""

    fitted: PointErrors | None = Field(description="The points that made it; null without any.")
    leave_one_out: PointErrors | None = Field(
        description="Each point by a calibration that never saw it; null without any point, or "
        f"with more than {MAX_LEAVE_ONE_OUT_POINTS}: see `blocks_left_out`."
    )
    blocks_left_out: PointErrors | None = Field(
        default=None,
        description="Each point by a calibration that never saw its block of space, as in the "
        "result's `cross_validation`; null where that was not made.",
    )
    lengths_left_out: LengthErrors | None = Field(
        default=None,
        description="Of a self-calibration: lengths at poses held out; null: too few poses, or "
        "made by an earlier version.",
    )


class ParentCalibration(ResponseModel):
    """The calibration that an updated one was made from."""

    id: str
    content_hash: str


class CalibratedProfile(ResponseModel):
    """The device profile that a nominal calibration was computed from."""

    profile_id: str = Field(description="The profile's name.")
    content_hash: str = Field(description="SHA-256 of the profile's file, its `toml`.")


class CalibrationSummary(ResponseModel):
    """A calibration without its numbers."""

    id: str
    device_id: str
    state: State
    provenance: Provenance = Field(
        description="`fitted`: from control points. `self-calibrated`: from targets at unknown "
        "poses. `updated`: from its `parent` and stationary markers. `nominal`: a design's values, "
        "not measured."
    )
    method: Method
    note: str
    point_count: int
    content_hash: str = Field(
        description="SHA-256 of the canonical JSON (sorted keys, no spaces, UTF-8) of the object "
        "of the members device, provenance, points, result and, where they are not null, parent "
        "and profile, as a GET of the calibration sends them."
    )
    profile: CalibratedProfile | None = Field(
        default=None,
        description="Of a nominal one of a device profile: it is activated only on a device that "
        "is simulated from this profile. Null in those of earlier versions.",
    )
    created_at: Moment
    retired_at: Moment | None


class CalibrationDocument(CalibrationSummary):
    """A calibration, whole."""

    parent: ParentCalibration | None = Field(
        default=None, description="Of an updated one, which was made from it."
    )
    points: list[ControlPoint]
    result: Calibration
    errors: ControlPointErrors


class ComparisonDocument(ResponseModel):
    """Two calibrations of one device beside one another."""

    calibration_id: str
    other_calibration_id: str
    comparison: Comparison
