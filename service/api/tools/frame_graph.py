"""Transform graph of a device's frames at its newest exposure."""

import time
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from sqlalchemy.orm import Session

from compute.errors import UnknownFrame
from compute.pose.rigid_body import PoseStatus
from compute.pose.transform_graph import TransformGraph
from compute.transform import Transform, rotation_quaternion
from service.api.tools.frame_conversion import POSE_STATUSES
from service.api.tools.pose_query import board_pose
from service.api.tools.provenance import active_ids, provenance
from service.api.tools.registrations import REGISTRATIONS, frame_from_measured
from service.api.tools.schema import TRACKER
from service.api.tools.store import tools
from service.pipeline.frame_batch import PoseEntry
from service.pipeline.interface import Pipeline


@dataclass(frozen=True, eq=False)
class Node:
    """A frame and its own transform, to the frame that it was measured in.

    Args:
        name: of it.
        kind: what it is of.
        to: that other frame; None: it is the tracker.
        status: what the transform is worth.
        reason: why not OK.
        to_from: T_to_name; None: there is none now.
    """

    name: str
    kind: Literal["tracker", "tool", "registration"]
    to: str | None
    status: PoseStatus = PoseStatus.OK
    reason: str | None = None
    to_from: Transform | None = None


class DeviceFrames:
    """A device's frames at its newest frame, by name, and the graph of those connected."""

    def __init__(self, device_id: str, nodes: list[Node], entry: PoseEntry | None) -> None:
        """Connect what has a transform."""
        self.device_id = device_id
        self.nodes = {node.name: node for node in nodes}
        self._entry = entry
        self._graph = TransformGraph()
        for node in nodes:
            if node.to is not None and node.to_from is not None:
                self._graph.connect(node.to, node.name, node.to_from)

    @property
    def instant(self) -> dict[str, Any]:
        """The members of answers that say when, and with which calibration."""
        entry = self._entry
        if entry is None:
            names = ("exposure_ns", "sequence", "age_s", "calibration_id", "table_id")
            return dict.fromkeys(names)
        by_clock = (time.time_ns() - entry.exposure_ns) * 1e-9
        return {
            "exposure_ns": entry.exposure_ns,
            "sequence": entry.sequence,
            "age_s": max(by_clock, time.monotonic() - entry.arrived_s),
            "calibration_id": entry.calibration_id,
            "table_id": entry.table_id,
        }

    def root(self, name: str) -> str:
        """Return where the way up from a frame ends now; the same root: they are connected."""
        node = self.nodes[name]
        while node.to is not None and node.to_from is not None:
            node = self.nodes[node.to]
        return node.name

    def transform(self, to: str, name: str) -> dict[str, Any]:
        """Return the members of FrameTransform.

        Raises:
            UnknownFrame: the device has no frame of one of the names.
        """
        for one in (name, to):
            if one not in self.nodes:
                listed = ", ".join(f'"{known}"' for known in self.nodes)
                raise UnknownFrame(
                    f'device "{self.device_id}" has no frame "{one}"; it has {listed}', frame_id=one
                )
        members: dict[str, Any] = dict.fromkeys(
            (
                "path_frame_ids",
                "matrix",
                "translation_mm",
                "rotation",
                "quaternion_wxyz",
                "covariance",
            )
        )
        members |= {"device_id": self.device_id, "frame_id": name, "to_frame_id": to} | self.instant
        found = self._find_path(to, name)
        if found is None:
            status, reason = self._why_not(to, name)
            return members | {"status": status, "reason": reason}
        transform, path = found
        # Of a path every link is that of one of its frames, up to another one of them.
        over = [self.nodes[one] for one in path if self.nodes[one].to in path]
        worst = max(over, key=lambda one: POSE_STATUSES.index(one.status), default=None)
        covariance = transform.covariance
        return members | {
            "status": PoseStatus.OK if worst is None else worst.status,
            "reason": None if worst is None or worst.reason is None else _describe_node(worst),
            "path_frame_ids": list(path),
            "matrix": transform.matrix.tolist(),
            "translation_mm": transform.translation_mm.tolist(),
            "rotation": transform.rotation.tolist(),
            "quaternion_wxyz": rotation_quaternion(transform.rotation).tolist(),
            "covariance": (np.zeros((6, 6)) if covariance is None else covariance).tolist(),
        }

    def _find_path(self, to: str, name: str) -> tuple[Transform, tuple[str, ...]] | None:
        if to == name:
            return Transform.identity(), (name,)
        try:
            found = self._graph.transform(to, name)
        except UnknownFrame:
            return None
        return found.transform, found.path

    def _why_not(self, to: str, name: str) -> tuple[PoseStatus, str]:
        """Return the first transform that is missing on the way up from either frame."""
        for start in (name, to):
            node = self.nodes[start]
            while node.to is not None:
                if node.to_from is None:
                    return node.status, _describe_node(node)
                node = self.nodes[node.to]
        raise AssertionError(f"{name} and {to} are connected with the tracker")


def _describe_node(node: Node) -> str:
    return f'{node.kind} "{node.name}": {node.reason}'


def device_frames(session: Session, live: Pipeline, device_id: str) -> DeviceFrames:
    """Return a device's frames: the tracker's, its tools' and those of its registrations."""
    entry = live.poses.newest().get(device_id)
    now_ns = time.time_ns()
    active = active_ids(session, device_id)
    calibration_and_table = active["calibration_id"], active["table_id"]
    if entry is not None and entry.calibration_id is not None:
        calibration_and_table = entry.calibration_id, entry.table_id
    nodes = [Node(TRACKER, "tracker", None)]
    for tool in session.scalars(tools(device_id)):
        pose = board_pose(live, tool.id, device_id, entry, now_ns)
        known = pose.transform() if pose.rotation is not None else None
        nodes.append(Node(tool.id, "tool", TRACKER, pose.status, pose.reason, known))
    for row in session.scalars(REGISTRATIONS.newest_first(device_id=device_id)):
        to = row.reference_id or TRACKER
        why = provenance(session, row).invalid_reason(*calibration_and_table)
        if why is not None:
            nodes.append(Node(row.id, "registration", to, PoseStatus.INVALID, why))
            continue
        known = frame_from_measured(row).inverse()
        nodes.append(Node(row.id, "registration", to, to_from=known))
    return DeviceFrames(device_id, nodes, entry)
