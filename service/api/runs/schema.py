"""Runs as clients send and receive them."""

from typing import Annotated

from pydantic import Field

from compute.mapping.result import MappingMethod, MappingSettings
from hardware.field_bounds import FIRST_ERROR_ONLY
from service.api.base_models import (
    Moment,
    Note,
    RequestModel,
    ResponseModel,
    Slug,
    from_attributes,
)
from service.api.calibrations.schema import (
    MAX_POINTS,
    CalibrationOptions,
    ControlPoint,
    SensorName,
)
from service.api.drift_checks.schema import StationaryMarkersRequest
from service.api.runs.kind_registry import RESULTS
from service.database.models import RunRow
from service.jobs.store import Kind, State

RunId = Annotated[Slug | None, Field(description="The run's; left out: the server's choice.")]
CalibrationToMake = Annotated[
    Slug | None,
    Field(description="Of the calibration to be made; left out: the server's choice."),
]
Pitch = Annotated[float, Field(gt=0, le=1e6)]


class RunProblem(ResponseModel):
    """Why a run failed: the members of a problem document (RFC 9457)."""

    type: str = Field(description="URI reference of the problem type; GET it for its meaning.")
    title: str
    status: int
    detail: str
    context: dict[str, object] | None = None


class Run(ResponseModel):
    """A computation beside the requests, and what became of it."""

    id: str
    kind: Kind
    device_id: str
    state: State = Field(
        description="`interrupted`: the server ended while it ran; post it again. Of the others "
        "`queued` and `running` change by themselves."
    )
    progress: float = Field(ge=0, le=1, description="Share done.")
    stage: str = Field(description="What is being done, in words.")
    result_id: str | None = Field(
        description="The calibration, table or export made, once succeeded."
    )
    result_path: str | None = Field(description="Its path.")
    problem: RunProblem | None = Field(description="Why it failed.")
    created_at: Moment
    started_at: Moment | None
    finished_at: Moment | None


class PointsRequest(RequestModel):
    """Control points, or a capture session that holds them."""

    points: Annotated[list[ControlPoint], Field(max_length=MAX_POINTS), FIRST_ERROR_ONLY] | None = (
        Field(default=None, description="Give these, or `capture_id`.")
    )
    capture_id: Slug | None = Field(
        default=None, description="A capture session, in place of points."
    )
    allow_incomplete: bool = Field(
        default=False, description="Take a capture session of which targets are missing."
    )


class NewCalibrationRun(PointsRequest, CalibrationOptions):
    """Control points, or a capture session that holds them, from which a device is calibrated."""

    id: RunId = None
    device_id: Slug
    result_id: CalibrationToMake = None
    note: Note = ""


class NewMappingRun(PointsRequest):
    """Measurements at known places, from which a correction table is built for a calibration."""

    id: RunId = None
    device_id: Slug
    calibration_id: Slug | None = Field(
        default=None, description="The table's parent; left out: the device's active calibration."
    )
    result_id: Slug | None = Field(
        default=None, description="Of the table to be made; left out: the server's choice."
    )
    method: MappingMethod = Field(
        default="b-spline",
        description="`b-spline`: penalised, for points anywhere. `trilinear`, `tricubic`: through "
        "every measured value, for points on a grid.",
    )
    pitch_mm: tuple[Pitch, Pitch, Pitch] | None = Field(
        default=None, description="Edges of the cells; left out: from the data."
    )
    penalty_weight: Annotated[float, Field(gt=0, le=1e12)] | None = Field(
        default=None, description="Weight of the penalty; left out: by cross-validation."
    )
    min_neighbours: Annotated[int, Field(ge=1, le=1000)] = Field(
        default=4, description="Measurements near a cell without which it is not supported."
    )
    position_sigma_mm: Annotated[float, Field(ge=0, le=1000)] = Field(
        default=0.0, description="Standard deviation of each coordinate of the points."
    )
    note: Note = ""

    def settings(self) -> MappingSettings:
        """Return the settings for the computation; raises InvalidParameter."""
        return MappingSettings(self.method, self.pitch_mm, self.penalty_weight, self.min_neighbours)


class NewUpdateRun(StationaryMarkersRequest):
    """Still markers read again, or a drift check that holds them, that bring a calibration up to
    date.
    """

    id: RunId = None
    device_id: Slug
    calibration_id: Slug | None = Field(
        default=None,
        description="The parent; left out: the drift check's, or the device's active calibration.",
    )
    result_id: CalibrationToMake = None
    drift_check_id: Slug | None = Field(
        default=None,
        description="A drift check of the parent: its markers, in place of points or capture.",
    )
    sensors: (
        Annotated[list[SensorName], Field(min_length=1, max_length=64), FIRST_ERROR_ONLY] | None
    ) = Field(
        default=None,
        description="Those that may have changed, as a drift check tells; left out: all.",
    )
    allowance: (
        Annotated[
            dict[SensorName, Annotated[float, Field(gt=0, le=1e6)]],
            Field(min_length=1, max_length=64),
        ]
        | None
    ) = Field(
        default=None,
        description="Standard deviation of what each parameter may have changed by, by its name in "
        "the models; others stay. Left out: rotations of 5 mrad about each axis "
        "through the lens and 10 px of the principal distance.",
    )
    note: Note = ""


def run_document(row: RunRow) -> Run:
    """Return the run."""
    path = None
    if row.result_id is not None:
        path = f"{RESULTS[row.kind]}/{row.result_id}"
    return from_attributes(Run, row, result_path=path)
