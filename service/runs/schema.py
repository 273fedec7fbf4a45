"""Runs as clients send and receive them."""

from typing import Annotated

from pydantic import Field

from compute.calibration.settings import Distortion, LabelPolicy
from service.calibrations.schema import MAX_POINTS, CalibrationOptions, ControlPoint
from service.runs.store import Kind, State
from service.schema import Document, Moment, Note, Slug


class RunProblem(Document):
    """Why a run failed: the members of a problem document (RFC 9457)."""

    type: str = Field(description="URI reference of the problem type; GET it for its meaning.")
    title: str
    status: int
    detail: str
    context: dict[str, object] | None = None


class Run(Document):
    """A computation beside the requests, and what became of it."""

    id: str
    kind: Kind
    device: str
    state: State = Field(
        description="`interrupted`: the server ended while it ran; post it again. Of the others "
        "`queued` and `running` change by themselves."
    )
    progress: float = Field(ge=0, le=1, description="Share done.")
    stage: str = Field(description="What is being done, in words.")
    result_id: str | None = Field(description="The calibration or table made, once succeeded.")
    result: str | None = Field(description="Its path.")
    problem: RunProblem | None = Field(description="Why it failed.")
    created_at: Moment
    started_at: Moment | None
    finished_at: Moment | None


class NewCalibrationRun(CalibrationOptions):
    """Control points, or a capture session that holds them, from which a device is calibrated."""

    distortion: Distortion = Field(
        default="auto",
        description="As of a calibration; a run chooses the terms by cross-validation by default.",
    )
    labels: LabelPolicy = Field(
        default="report", description="As of a calibration; a run reports them by default."
    )
    id: Slug | None = Field(default=None, description="The run's; left out: the server's choice.")
    device: Slug
    result_id: Slug | None = Field(
        default=None, description="Of the calibration to be made; left out: the server's choice."
    )
    points: Annotated[list[ControlPoint], Field(max_length=MAX_POINTS)] | None = None
    capture: Slug | None = Field(default=None, description="A capture session, in place of points.")
    note: Note = ""
