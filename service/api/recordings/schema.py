"""Recordings as clients send and receive them."""

from typing import Annotated, Literal

from pydantic import Field, StringConstraints

from service.api.base_models import Moment, RequestModel, ResponseModel

NAME_PATTERN = r"^[A-Za-z0-9][A-Za-z0-9_-]*(\.[A-Za-z0-9_-]+)*\.h5$"
"""Of a recording that is begun here: a file of the folder itself."""

Content = Literal["lines", "results"]
State = Literal["recording", "complete", "incomplete", "failed", "unreadable"]


class NewRecording(RequestModel):
    """What is to be recorded, and until when."""

    id: Annotated[str, StringConstraints(max_length=100, pattern=NAME_PATTERN)] | None = Field(
        default=None, description="File name, ending in .h5; null: device and time."
    )
    contents: Annotated[frozenset[Content], Field(min_length=1)] = Field(
        default=frozenset({"lines", "results"}),
        description="`lines`: the line scans as they came; only with them it can be replayed. "
        "`results`: peaks and points as they are made live.",
    )
    max_duration_s: Annotated[float, Field(gt=0.0, le=1e6)] | None = Field(
        default=None, description="Most time, by the device's clock; null: no limit."
    )
    max_size_bytes: Annotated[int, Field(ge=2**20, le=2**50)] | None = Field(
        default=None, description="About the largest size of the file; null: no limit."
    )


class UsedCalibration(ResponseModel):
    """A calibration that results were made with, whole in the file."""

    calibration_id: str | None = Field(description="Its id.")
    content_hash: str | None
    table_id: str | None = Field(description="Id of the correction table used with it.")
    radiometric_id: str | None = Field(
        description="Id of the radiometric calibration of the peaks."
    )
    bad_pixels: int = Field(
        description="Masked pixels that the live frames had shown to be bad until then."
    )
    from_frame: int | None = Field(
        description="The first frame of it, counted from 0; null: none yet."
    )


class RecordingDocument(ResponseModel):
    """A recording. What is null is not known, because the file cannot be read."""

    id: str = Field(description="File name below the folder `recordings`.")
    device_id: str | None = Field(description="The device that it is of, as it was called then.")
    state: State = Field(
        description="`recording`: being written by this server. `complete`: closed by its writer. "
        "`incomplete`: not closed; its writer died, or is another program that still writes: what "
        "it flushed can be read. `failed`: this server could not go on writing it. `unreadable`: "
        "no recording, or damaged."
    )
    reason: str | None = Field(description="Why it ended, or cannot be read.")
    contents: list[Content]
    frames_written: int | None = Field(description="Frames in the file: safe from a crash.")
    duration_s: float | None = Field(description="From the first to the last, device's clock.")
    frames_missing: int | None = Field(
        description="Missing in the sequence from the first frame to the last, for any reason."
    )
    frames_dropped_compute: int | None = Field(
        description="Frames dropped because the pipeline did not keep up."
    )
    frames_dropped_writer: int | None = Field(
        description="Frames dropped because the disk, or the writer, did not keep up; behind the "
        "last frame in the file they are not among the missing ones."
    )
    frames_refused: int | None = Field(
        description="Frames whose number or time went back, and are not in the file."
    )
    size_bytes: int
    started_at: Moment | None
    updated_at: Moment


class RecordingDetail(RecordingDocument):
    """A recording with what its results were made with."""

    calibrations: list[UsedCalibration]
