"""A device's frames, and the transforms between them, as clients receive them."""

from typing import Literal

from pydantic import Field

from compute.pose.rigid_body import PoseStatus
from service.api.base_models import Position, ResponseModel
from service.api.tools.schema import Matrix3, Matrix6


class FrameState(ResponseModel):
    """A frame, and whether it is connected with another one now."""

    id: str
    kind: Literal["tracker", "tool", "registration"]
    to_frame_id: str | None = Field(
        description="The frame that its own transform leads to: the tracker, or of a registration "
        "its reference tool; null: it is the tracker."
    )
    connected: bool = Field(description="Whether there is that transform now.")
    status: PoseStatus = Field(description="What it is worth: of a tool that of its pose.")
    reason: str | None = Field(description="Why the status is not OK.")
    root_frame_id: str = Field(
        description="Where the way over such transforms ends. Frames with the same root are "
        "connected with one another now."
    )


class FrameList(ResponseModel):
    """A device's frames at its newest frame."""

    device_id: str
    exposure_ns: int | None = Field(description="Of the newest frame, on the host's clock.")
    sequence: int | None
    age_s: float | None
    calibration_id: str | None
    table_id: str | None
    frames: list[FrameState]


class FrameTransform(ResponseModel):
    """The transform from one frame to another at a device's newest frame, or why there is none."""

    device_id: str
    frame_id: str
    to_frame_id: str
    status: PoseStatus = Field(
        description="The worst of the poses that it goes over; only with OK it is one to use."
    )
    reason: str | None
    path_frame_ids: list[str] | None = Field(
        description="The frames that it goes over, both included; null: nothing connects them."
    )
    exposure_ns: int | None
    sequence: int | None
    age_s: float | None
    calibration_id: str | None
    table_id: str | None
    matrix: tuple[tuple[float, float, float, float], ...] | None = Field(
        description="T_to_frame: takes coordinates in `frame_id` to those in `to_frame_id`; 4 x 4, "
        "row by row."
    )
    translation_mm: Position | None
    rotation: Matrix3 | None
    quaternion_wxyz: tuple[float, float, float, float] | None = Field(
        description="The turn as a unit quaternion, w >= 0."
    )
    covariance: Matrix6 | None = Field(
        description="Of a small turn [rad] about the axes of `to_frame_id`, on the left, and of "
        "the translation [mm], in this order. The poses that it goes over are taken to err "
        "independently."
    )
