"""ToolReport: pose and status of one tool, for text and binary replies."""

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.camera.rotation import rotation_quaternion
from compute.pose.rigid_body import PoseStatus, ToolPose
from service.protocols.ndi.fixed_point import MAX_MM, MAX_UNIT
from service.protocols.ndi.port_handles import PortHandle

Array = NDArray[np.float64]

MAX_MARKERS: Final = 20
"""Of a tool, that a reply has room for."""
OUT_OF_VOLUME: Final = 0x40
"""Of the port status."""
BAD_FIT: Final = 0x01
TOO_FEW_MARKERS: Final = 0x02
"""Of the tool information."""


class HandleState(IntEnum):
    """Whether a tool has a transformation."""

    VALID = 1
    MISSING = 2
    DISABLED = 4


@dataclass(frozen=True)
class ToolReport:
    """One tool.

    Args:
        handle: its port handle.
        state: whether the next three are there.
        quaternion: of R_world_tool, scalar first and not negative; None: there is none.
        translation_mm: the tool's origin in the world.
        error_mm: how far it may be off.
        port_status: bits.
        frame: its number, 32 bits.
        information: bits, why there is no transformation.
        markers_used: how many of its markers it comes from.
        markers_mm: where the pose puts its markers in the world; empty: not known, or no pose.
    """

    handle: int
    state: HandleState
    quaternion: tuple[float, ...] | None
    translation_mm: tuple[float, ...] | None
    error_mm: float
    port_status: int
    frame: int
    information: int
    markers_used: int
    markers_mm: tuple[tuple[float, ...], ...] = ()


def report(
    port: PortHandle,
    pose: ToolPose | None,
    frame: int,
    *,
    out_of_volume: bool,
    markers_mm: Array | None = None,
) -> ToolReport:
    """Return what is told of the tool behind a handle.

    Only poses that are OK are given; with ``out_of_volume`` those, too, that are good but outside
    of the volume. What is uncertain or does not fit is missing, and the information says so.

    Args:
        port: the handle.
        pose: the newest pose of its tool; None: there is none, or none that is new.
        frame: number of the frame.
        out_of_volume: whether the client wants poses outside of the volume.
        markers_mm: the tool's markers in its own coordinates, shape (M, 3) [mm]; None: not known.
    """
    status, information = port.status, 0
    if not port.enabled:
        return ToolReport(port.handle, HandleState.DISABLED, None, None, 0.0, status, frame, 0, 0)
    given = pose is not None and pose.status is PoseStatus.OK
    if pose is not None:
        if pose.status is PoseStatus.OUT_OF_VOLUME:
            status |= OUT_OF_VOLUME
            given = out_of_volume
        information = {
            PoseStatus.INVALID: BAD_FIT,
            PoseStatus.HIGH_ERROR: BAD_FIT,
            PoseStatus.MISSING: TOO_FEW_MARKERS,
            PoseStatus.OUT_OF_VIEW: TOO_FEW_MARKERS,
        }.get(pose.status, 0)
    if given and pose is not None and pose.rotation is not None and pose.translation_mm is not None:
        place = pose.translation_mm
        if np.isfinite(pose.rotation).all() and np.abs(place).max() <= MAX_MM:
            return ToolReport(
                port.handle,
                HandleState.VALID,
                tuple(rotation_quaternion(pose.rotation).tolist()),
                tuple(place.tolist()),
                error_mm(pose),
                status,
                frame,
                information,
                pose.markers_used,
                _in_world(pose.rotation, place, markers_mm),
            )
        # Nothing on the wire can say where it is.
        status |= OUT_OF_VOLUME
    used = 0 if pose is None else pose.markers_used
    return ToolReport(
        port.handle, HandleState.MISSING, None, None, 0.0, status, frame, information, used
    )


def _in_world(
    rotation: Array, translation_mm: Array, markers_mm: Array | None
) -> tuple[tuple[float, ...], ...]:
    if markers_mm is None:
        return ()
    found = markers_mm[:MAX_MARKERS] @ rotation.T + translation_mm
    return tuple(map(tuple, found.tolist())) if np.abs(found).max() <= MAX_MM else ()


def error_mm(pose: ToolPose) -> float:
    """Return the error of a pose as this protocol has it: one length, at most MAX_UNIT [mm].

    The standard deviation of the tool's origin in space, larger by as much as the readings
    disagree by more than their noise. A pose that does not say has the largest.
    """
    variance = np.nan if pose.covariance is None else float(np.trace(pose.covariance[3:, 3:]))
    if not variance >= 0.0:
        return MAX_UNIT
    found = math.sqrt(variance) * max(1.0, pose.residual_sigma or 0.0)
    return min(found, MAX_UNIT) if math.isfinite(found) else MAX_UNIT
