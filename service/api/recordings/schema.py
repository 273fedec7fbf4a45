"""Recordings as clients send and receive them."""

from typing import Annotated, Literal

from pydantic import Field, StringConstraints

from compute.pose.rigid_body import PoseStatus
from hardware.field_bounds import FIRST_ERROR_ONLY
from service.api.base_models import Moment, RequestModel, ResponseModel

NAME_PATTERN = r"^[A-Za-z0-9][A-Za-z0-9_-]*(\.[A-Za-z0-9_-]+)*\.h5$"
"""Of a recording that is begun here: a file of the folder itself."""

Content = Literal["lines", "results"]
Vector = tuple[float, float, float]
Matrix = tuple[Vector, Vector, Vector]
Row6 = tuple[float, float, float, float, float, float]
Matrix6 = tuple[Row6, Row6, Row6, Row6, Row6, Row6]
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
    gateway: str | None = Field(
        default=None,
        description="The gateway that has the file in its data directory, or writes it there; "
        "null: the one that answers. Only that one gives more than this.",
    )


class RecordedPoint(ResponseModel):
    """A point: as it was found while it was recorded, or worked out now from the same frame."""

    marker: int | None = Field(description="The strobed marker; null: all were lit.")
    position_mm: Vector | None = Field(description="Null: it has none.")
    covariance_mm2: Matrix | None = Field(
        description="Of the position; null also where `no-covariance` is among the flags."
    )
    residual_sigma: float | None = Field(
        description="Of its readings, in standard deviations; null: nothing checks them."
    )
    sensors: list[str] = Field(description="Those that it comes from.")
    flags: tuple[str, ...] = Field(description="As in the stream.")


class RecordedTrack(ResponseModel):
    """A track of a marker in a recorded frame, as in the stream."""

    id: int = Field(description="Number of the track.")
    marker: int | None = Field(description="Its strobe slot or blink code; null: not known.")
    state: Literal["tentative", "confirmed", "coasting"]
    flags: tuple[str, ...]
    position_mm: Vector
    covariance_mm2: Matrix | None = Field(
        description="Of the position; null: beyond the correction table, not known."
    )
    velocity_mm_s: Vector = Field(description="Of the marker.")
    velocity_covariance_mm2_s2: Matrix | None = Field(description="Of the velocity; null likewise.")
    acceleration_mm_s2: Vector | None = Field(description="Null: the motion has none.")
    peaks: tuple[int | None, ...] = Field(
        description="By sensor, the number of its peak in the scan; null: none."
    )
    nis: float | None = Field(description="Normalised innovation squared; null: not detected.")
    dof: int = Field(description="Its degrees of freedom.")


class RecordedToolPose(ResponseModel):
    """The pose of a tool in a recorded frame, in world coordinates, as in the stream."""

    tool_id: str
    status: PoseStatus = Field(description="Only a pose that is OK is one to use.")
    reason: str | None = Field(description="Why the status is not OK, in words.")
    translation_mm: Vector | None = Field(description="The tool's origin.")
    rotation: Matrix | None = Field(description="R_world_tool, row by row.")
    quaternion_wxyz: tuple[float, float, float, float] | None = Field(
        description="The same turn as a unit quaternion, w >= 0."
    )
    covariance: Matrix6 | None = Field(
        description="Of a small turn [rad] about the world's axes, on the left, and of the "
        "translation [mm], in this order."
    )
    tip_mm: Vector | None = Field(description="The tip; None: the tool has none.")
    tip_covariance_mm2: Matrix | None
    residual_sigma: float | None
    markers_used: int
    readings_used: int
    velocity_mm_s: Vector | None = Field(description="Of the tool's origin.")
    angular_velocity_rad_s: Vector | None = Field(description="About the world's axes.")
    detectable_sigma: float | None = Field(
        description="Smallest error of a reading that the test would have found, in its standard "
        "deviations."
    )
    external_tip_mm: float | None = Field(
        description="How far a wrong reading that the test did not find may move the tip."
    )
    external_rotation_rad: float | None = Field(description="And how far it may turn the tool.")


class RecordedFrame(ResponseModel):
    """One frame of a recording, with its points."""

    number: int = Field(description="Its place in the recording, from 0.")
    sequence: int = Field(description="The device's number of the exposure.")
    exposure_ns: int = Field(description="Middle of the exposure on the host's clock then [ns].")
    marker: int | None = Field(description="The strobed marker; null: all were lit.")
    points: list[RecordedPoint]
    tracks: list[RecordedTrack] | None = Field(description="Null: not asked for.")
    tools: list[RecordedToolPose] | None = Field(
        description="Of every tool that the device has now; null: not asked for."
    )


class RecordedFrames(ResponseModel):
    """Consecutive frames of a recording."""

    recording_id: str = Field(description="File name below the folder `recordings`.")
    calibration_id: str | None = Field(
        description="The calibration of the request, with which the results were worked out now; "
        "null: those of the recording."
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
