"""The newest pose of a tool in the frame that is asked for, as clients receive it."""

import time
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from sqlalchemy.orm import Session

from compute.errors import InvalidParameter
from compute.pose.rigid_body import PoseStatus, ToolPose
from compute.transform import Transform, rotation_quaternion
from service.api.tools.frame_conversion import pose_in_frame
from service.api.tools.provenance import Provenance, provenance
from service.api.tools.registrations import frame_from_measured
from service.api.tools.rigid_bodies import tip_of
from service.api.tools.schema import TRACKER, Pose
from service.database.models import RegistrationRow, ToolRow
from service.pipeline.frame_batch import PoseEntry, pose_members
from service.pipeline.interface import Pipeline
from service.problems.errors import UnknownTool

STALE_S: Final = 1.0
"""A pose older than this is none, or than this many frames where they come more slowly:"""
STALE_FRAMES: Final = 5.0


@dataclass(frozen=True, eq=False)
class Frame:
    """A frame of reference in which poses can be expressed.

    Args:
        name: of it.
        reference: the tool that it goes with; None: it stays in the tracker's.
        frame_from: the transform to it from that tool's; None: it is that tool's.
        made_with: what it was registered with; None: it is no registered frame.
    """

    name: str
    reference: str | None = None
    frame_from: Transform | None = None
    provenance: Provenance | None = None


def frame_of(session: Session, tool: ToolRow, wanted: str | None) -> Frame:
    """Return the frame that a pose is asked for in; None: relative to the tool's reference.

    Raises:
        UnknownTool: neither a tool nor a registration has this name.
        InvalidParameter: it is another device's, or the tool's own.
    """
    name = tool.reference_id or TRACKER if wanted is None else wanted
    if name == TRACKER:
        return Frame(TRACKER)
    found: ToolRow | RegistrationRow | None = session.get(ToolRow, name)
    found = session.get(RegistrationRow, name) if found is None else found
    if found is None:
        raise UnknownTool(
            f'no tool and no registration is called "{name}"; a frame is one of these, or '
            f'"{TRACKER}"',
            frame_id=name,
        )
    if found.device_id != tool.device_id:
        raise InvalidParameter(
            f'frame "{name}" is of device "{found.device_id}", and tool "{tool.id}" of '
            f'"{tool.device_id}"; nothing connects them',
            frame_id=name,
        )
    if isinstance(found, RegistrationRow):
        return Frame(
            name,
            found.reference_id,
            frame_from_measured(found),
            provenance(session, found),
        )
    if name == tool.id:
        raise InvalidParameter(f'frame "{name}" is the tool\'s own; ask for another', frame_id=name)
    return Frame(name, name)


def newest_pose(live: Pipeline, tool: ToolRow, frame: Frame, max_tip_sd_mm: float) -> Pose:
    """Return the newest pose of a tool, or the reason why there is none; a stale one is none.

    Args:
        live: the running devices.
        tool: the tool.
        frame: that the pose is to be in.
        max_tip_sd_mm: standard deviation of the tip there above which it is HIGH_ERROR [mm].
    """
    entry = live.poses.newest().get(tool.device_id)
    now_ns = time.time_ns()
    pose = board_pose(live, tool.id, tool.device_id, entry, now_ns)
    reference = None
    if frame.reference is not None:
        reference = board_pose(live, frame.reference, tool.device_id, entry, now_ns)
    spread = tip_of(tool).covariance_mm2
    moved = pose_in_frame(
        pose,
        reference,
        frame.frame_from,
        None if spread is None else np.array(spread),
        max_tip_sd_mm,
    )
    if frame.provenance is not None and entry is not None and entry.calibration_id is not None:
        why = frame.provenance.invalid_reason(entry.calibration_id, entry.table_id)
        if why is not None:
            moved = ToolPose(tool.id, PoseStatus.INVALID, why, moved.exposure_ns, moved.sequence)
    seen = entry is not None
    members: dict[str, Any] = pose_members(moved) | {
        "device_id": tool.device_id,
        "frame_id": frame.name,
        "exposure_ns": moved.exposure_ns if seen else None,
        "sequence": moved.sequence if seen else None,
        "age_s": None if entry is None else _age_s(entry, moved, now_ns),
        "calibration_id": None if entry is None else entry.calibration_id,
        "table_id": None if entry is None else entry.table_id,
        "matrix": None,
    }
    if moved.rotation is not None and moved.translation_mm is not None:
        matrix = Transform(moved.rotation, moved.translation_mm).matrix
        members["matrix"] = matrix.tolist()
        members["quaternion_wxyz"] = rotation_quaternion(moved.rotation).tolist()
    return Pose.model_validate(members)


def board_pose(
    live: Pipeline, tool_id: str, device_id: str, entry: PoseEntry | None, now_ns: int
) -> ToolPose:
    """Return what the board has of a tool, or the reason why it has nothing to go by."""
    if entry is None:
        status = live.status(device_id)
        why = "" if status.reason is None else f": {status.reason}"
        reason = f'device "{device_id}" is {status.state}{why}'
        if status.state == "running":
            reason = f'device "{device_id}" has not sent a frame yet'
        return ToolPose(tool_id, PoseStatus.UNKNOWN, reason, 0, 0)
    pose = entry.poses.get(tool_id)
    if pose is None:
        reason = "the device does not track it yet"
        return ToolPose(tool_id, PoseStatus.UNKNOWN, reason, entry.exposure_ns, entry.sequence)
    age_s = _age_s(entry, pose, now_ns)
    rate = entry.frame_rate_hz
    limit_s = max(STALE_S, STALE_FRAMES / rate) if rate > 0.0 else STALE_S
    if age_s <= limit_s:
        return pose
    none = ToolPose(tool_id, PoseStatus.MISSING, None, pose.exposure_ns, pose.sequence)
    return replace(none, reason=f"its last frame is {age_s:.1f} s old")


def _age_s(entry: PoseEntry, pose: ToolPose, now_ns: int) -> float:
    """Return how old a pose is [s]: no younger than its entry, also where the clock is set back."""
    return max((now_ns - pose.exposure_ns) * 1e-9, time.monotonic() - entry.arrived_s)
