"""Recordings as clients send and receive them."""

from typing import Annotated, Literal

from pydantic import Field, StringConstraints

from hardware.field_bounds import FIRST_ERROR_ONLY
from service.api.base_models import Moment, RequestModel, ResponseModel

NAME_PATTERN = r"^[A-Za-z0-9][A-Za-z0-9_-]*(\.[A-Za-z0-9_-]+)*\.h5$"
"""Of a recording that is begun here: a file of the folder itself."""

Content = Literal["lines", "results"]
State = Literal["recording", "complete", "incomplete", "failed", "unreadable"]


class NewRecording(RequestModel):
    """Request of a recording: its content, and when it ends."""

    id: Annotated[str, StringConstraints(max_length=100, pattern=NAME_PATTERN)] | None = Field(
        default=None, description="File name, ending in .h5; null: device and time."
    )
    contents: Annotated[frozenset[Content], Field(min_length=1), FIRST_ERROR_ONLY] = Field(
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


class RecordedPoint(ResponseModel):
    """A point as it was found while it was recorded, or is by another calibration."""

    marker: int | None = Field(description="The strobed marker; null: all were lit.")
    position_mm: tuple[float, float, float] | None = Field(description="Null: it has none.")
    covariance_mm2: (
        tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]
        | None
    ) = Field(description="Of the position.")
    residual_sigma: float | None = Field(
        description="Of its readings, in standard deviations; null: nothing checks them."
    )
    sensors: list[str] = Field(description="Those that it comes from.")
    flags: tuple[str, ...] = Field(description="As in the stream.")


class RecordedFrame(ResponseModel):
    """One frame of a recording, with its points."""

    number: int = Field(description="Its place in the recording, from 0.")
    sequence: int = Field(description="The device's number of the exposure.")
    exposure_ns: int = Field(description="Middle of the exposure on the host's clock then [ns].")
    marker: int | None = Field(description="The strobed marker; null: all were lit.")
    points: list[RecordedPoint]


class RecordedFrames(ResponseModel):
    """Consecutive frames of a recording."""

    recording_id: str = Field(description="File name below the folder `recordings`.")
    calibration_id: str | None = Field(
        description="The calibration that the points were worked out with now; null: they are as "
        "they were found live."
    )
    frames_written: int = Field(description="Frames in the file.")
    frames: list[RecordedFrame]


class RecordingDetail(RecordingDocument):
    """A recording with the calibrations of its results."""

    calibrations: list[UsedCalibration]


class RetentionDocument(ResponseModel):
    """Retention of recordings: limits, where null is none, and deletions."""

    max_age_s: float | None = Field(
        description="Since a file was last changed; setting `recording_max_age_days`."
    )
    max_total_bytes: int | None = Field(
        description="Of all recordings; the oldest are deleted first. Setting "
        "`recording_max_total_bytes`."
    )
    checked_at: Moment | None = Field(description="Last check; null: none yet, or no limit.")
    total_bytes: int = Field(description="Size of all recordings after the last check.")
    held_recording_ids: list[str] = Field(
        description="Over a limit and kept all the same: a device replays it, an open run reads "
        "it, or the file cannot be read."
    )
    deleted_recordings: int = Field(description="Since the server's start.")
    deleted_bytes: int = Field(description="Since the server's start.")
