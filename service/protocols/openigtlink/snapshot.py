"""Snapshot: all poses of one instant: named, relative, encoded once for all clients."""

import time
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.pose.rigid_body import PoseStatus, ToolPose
from service.api.tools.frame_conversion import POSE_STATUSES, status_rank
from service.api.tools.tip_limit import TipLimit, exceeded_reason, tip_sd_mm
from service.pipeline.frame_batch import PoseEntry
from service.pipeline.transform_names import TRACKER, TransformName, frame_name
from service.protocols.openigtlink.bodies import (
    Tracking,
    write_position,
    write_tracking,
    write_transform,
)
from service.protocols.openigtlink.message import BadMessage, Message, write_message
from service.protocols.openigtlink.transforms import ToolNames, inverse_of

Array = NDArray[np.float64]

_LARGEST: Final = 1e30
"""Of what float32 holds; what is larger is no place."""
STALE_S: Final = 1.0
"""A pose that is older is not sent, and clients are told that no newer one comes."""
_MISSED: Final = 5.0
"""The same for slower devices, in missing frames."""
_NUMBERS: Final = 2**32
FULL_NAME: Final = "IGTL_DEVICE_NAME"
"""Metadata by which PLUS tells a name that is longer than its field."""


@dataclass(frozen=True, eq=False)
class WirePose:
    """One tool's pose as it is sent.

    Args:
        name: of its transform.
        status: what it is worth: OK only if the tool's and its reference's are, and the tip's
            standard deviation in the frame is below the limit.
        reason: why it is not OK.
        placed: R_frame_tool, shape (3, 3), and the tool's origin in the frame, shape (3,) [mm];
            None: there is no pose.
        source: the tool's pose in the device's coordinates.
        tip_sd_mm: standard deviation of the tip in the frame, all directions together [mm]; None:
            not known.
    """

    name: TransformName
    status: PoseStatus
    reason: str | None
    placed: tuple[Array, Array] | None
    source: ToolPose
    tip_sd_mm: float | None = None

    @property
    def valid(self) -> bool:
        """Whether it may be used for navigation."""
        return self.status is PoseStatus.OK


class Snapshot:
    """One entry of the board. Nothing is computed before a client wants it.

    Args:
        entry: from the board.
        naming: the names of the device's tools.
        arrived_s: when it came, as time.monotonic() counts [s].
        limits: on the error of poses, by the tool's id; tools without one are judged by the
            tracker only.
    """

    def __init__(
        self,
        entry: PoseEntry,
        naming: ToolNames,
        arrived_s: float = 0.0,
        limits: Mapping[str, TipLimit] = MappingProxyType({}),
    ) -> None:
        self.entry = entry
        self.naming = naming
        self.arrived_s = arrived_s
        self._limits = limits
        self._sent: dict[tuple[str, int, bool], bytes] = {}

    @property
    def stale_s(self) -> float:
        """Largest age at which its poses are still sent [s]."""
        rate = self.entry.frame_rate_hz
        return max(STALE_S, _MISSED / rate) if rate > 0.0 else STALE_S

    @property
    def age_s(self) -> float:
        """Age since its exposure, or since it came, whichever is more [s].

        A server that does not keep up puts up poses that are old already; one whose clock has been
        set does not know how old.
        """
        exposed = (time.time_ns() - self.entry.exposure_ns) * 1e-9
        return max(exposed, time.monotonic() - self.arrived_s)

    @property
    def fresh(self) -> bool:
        """Whether it is not too old to be sent."""
        return self.age_s <= self.stale_s

    @cached_property
    def poses(self) -> tuple[WirePose, ...]:
        """Every tool's pose in the frame that its name says."""
        return tuple(
            self._pose(self.entry.poses[tool], name)
            for tool, name in self.naming.names.items()
            if tool in self.entry.poses
        )

    def poses_in(self, frame: str) -> tuple[WirePose, ...]:
        """Return every tool's pose in one frame, but of the frame itself.

        Args:
            frame: ``Tracker``, a tool's id, or its name as a frame; empty: each in its own.

        Raises:
            BadMessage: there is no such frame.
        """
        if not frame:
            return self.poses
        target = self._tool_of(frame)
        return tuple(
            self._pose(
                self.entry.poses[tool],
                TransformName(name.short, f"{tool}To{frame_name(target)}", target),
            )
            for tool, name in self.naming.names.items()
            if tool in self.entry.poses and tool != target
        )

    def messages(
        self, kind: str, version: int, *, invalid: bool, poses: tuple[WirePose, ...] | None = None
    ) -> list[Message]:
        """Return one TRANSFORM or POSITION for each tool that has a pose to send.

        Args:
            kind: of message.
            version: of the header.
            invalid: also poses that are not OK, marked so; version 1 cannot mark them.
            poses: other ones than all.
        """
        write = write_transform if kind == "TRANSFORM" else write_position
        return [
            Message(
                kind,
                pose.name.short,
                write(*pose.placed),
                pose.source.exposure_ns,
                version,
                self._metadata(pose) if version > 1 else {},
                pose.source.sequence % _NUMBERS,
            )
            for pose in (self.poses if poses is None else poses)
            if pose.placed is not None and (pose.valid or (invalid and version > 1))
        ]

    def encoded(self, kind: str, version: int, *, invalid: bool) -> bytes:
        """Return the bytes of ``messages``, made once for all clients."""
        key = (kind, version, invalid)
        encoded = self._sent.get(key)
        if encoded is None:
            messages = self.messages(kind, version, invalid=invalid)
            encoded = self._sent[key] = b"".join(map(write_message, messages))
        return encoded

    def tracking(self, kind: Tracking, version: int, device: str, frame: str) -> Message:
        """Return TDATA or QTDATA of all tools whose pose is OK: the protocol leaves others out.

        Raises:
            BadMessage: there is no such frame.
        """
        poses = self.poses_in(frame)
        tools = [
            (pose.name.short, *pose.placed)
            for pose in poses
            if pose.valid and pose.placed is not None
        ]
        metadata = {}
        if version > 1:
            metadata = {f"{pose.name.full}Status": pose.status.value for pose in poses}
            metadata |= self._of_frame()
        return Message(
            kind,
            device,
            write_tracking(kind, tools),
            self.entry.exposure_ns,
            version,
            metadata,
            self.entry.sequence % _NUMBERS,
        )

    def find(self, name: str) -> WirePose | None:
        """Return the pose of a transform by its name on the wire, or its whole name."""
        for pose in self.poses:
            if name in (pose.name.short, pose.name.full):
                return pose
        return None

    def find_inverse(self, name: str) -> WirePose | None:
        """Return the pose of which a name is the inverse's: ``TrackerToProbe``."""
        names = (one for pose in self.poses for one in (pose.name.short, pose.name.full))
        inverse = inverse_of(name, names)
        return None if inverse is None else self.find(inverse)

    def _tool_of(self, frame: str) -> str | None:
        if frame == TRACKER:
            return None
        for tool in self.naming.names:
            if frame in (tool, frame_name(tool)):
                return tool
        systems = ", ".join([TRACKER, *map(frame_name, self.naming.names)])
        raise BadMessage(f'there is no coordinate system "{frame}"; there are {systems}')

    def _pose(self, tool: ToolPose, name: TransformName) -> WirePose:
        status, reason = tool.status, tool.reason
        rotation, translation = tool.rotation, tool.translation_mm
        if rotation is None or translation is None:
            return WirePose(name, _not_ok(status), reason, None, tool)
        frame: ToolPose | None = None
        if name.frame is not None:
            frame = self.entry.poses.get(name.frame)
            if frame is None or frame.rotation is None or frame.translation_mm is None:
                pose_status = PoseStatus.MISSING if frame is None else _not_ok(frame.status)
                why = "is not tracked" if frame is None else frame.reason
                return WirePose(name, pose_status, f'reference "{name.frame}": {why}', None, tool)
            if status_rank(frame.status) > status_rank(status):
                status, reason = frame.status, f'reference "{name.frame}": {frame.reason}'
            translation = frame.rotation.T @ (translation - frame.translation_mm)
            rotation = frame.rotation.T @ rotation
        if not (np.abs(rotation) < _LARGEST).all() or not (np.abs(translation) < _LARGEST).all():
            # NaN too, which is not smaller than anything.
            why = "its pose is not finite"
            return WirePose(name, PoseStatus.INVALID, why, None, tool)
        limit = self._limits.get(tool.tool)
        sd_mm = tip_sd_mm(tool, frame, None if limit is None else limit.tip_covariance_mm2)
        if limit is not None and sd_mm is not None and status in POSE_STATUSES[:-1]:
            above = exceeded_reason(sd_mm, limit.max_sd_mm)
            if above is not None:
                status, reason = PoseStatus.HIGH_ERROR, above
        return WirePose(name, status, reason, (rotation, translation), tool, sd_mm)

    def _metadata(self, pose: WirePose) -> dict[str, str]:
        source = pose.source
        metadata = {
            "TransformValid": "1" if pose.valid else "0",
            "TransformStatus": pose.status.value,
            "MarkersUsed": str(source.markers_used),
        }
        if pose.name.full != pose.name.short:
            metadata[FULL_NAME] = pose.name.full
        if source.residual_sigma is not None:
            metadata["ResidualSigma"] = f"{source.residual_sigma:.4g}"
        if pose.tip_sd_mm is not None:
            metadata["TipSigmaMm"] = f"{pose.tip_sd_mm:.4g}"
        if not pose.valid and pose.reason:
            metadata["TransformReason"] = pose.reason
        return metadata | self._of_frame()

    def _of_frame(self) -> dict[str, str]:
        late_ms = (time.time_ns() - self.entry.exposure_ns) / 1e6
        return {"FrameNumber": str(self.entry.sequence), "LatencyMs": f"{late_ms:.3f}"}


def _not_ok(status: PoseStatus) -> PoseStatus:
    """Return the status of a tool without a pose; never OK."""
    return PoseStatus.MISSING if status is PoseStatus.OK else status
