"""TX and BX: the newest poses of the tools that a client has initialised, as text or binary."""

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.pose.rigid_body import PoseStatus, ToolPose
from compute.transform import rotation_quaternion
from service.protocols.ndi.client_state import ClientState
from service.protocols.ndi.command import ReplyOption, binary_reply, reply_option, text_reply
from service.protocols.ndi.port_handles import PortHandle
from service.protocols.ndi.pose_feed import PoseView

MAX_UNIT: Final = 9.9999
"""Largest number of 4 decimals: quaternions, errors."""
MAX_MM: Final = 9999.99
"""Largest number of 2 decimals: positions."""


class TooLarge(Exception):
    """A number has more digits than its place."""


def unit(value: float) -> str:
    """Return a number as sign and 5 digits, 4 of them behind the point; raises TooLarge."""
    return _digits(value, 4, 5)


def millimetres(values: Sequence[float]) -> str:
    """Return lengths as sign and 6 digits each, 2 of them behind the point; raises TooLarge."""
    return "".join(_digits(value, 2, 6) for value in values)


def _digits(value: float, decimals: int, width: int) -> str:
    if not abs(value) < 10.0 ** (width - decimals):  # NaN, too
        raise TooLarge
    scaled = round(value * 10**decimals)
    if abs(scaled) >= 10**width:
        raise TooLarge
    # A rounded -0.001 has no minus: whole is an integer.
    return f"{scaled:+0{width + 1}d}"


Array = NDArray[np.float64]

MAX_MARKERS: Final = 20
"""Of a tool, that a reply has room for."""
OUT_OF_VOLUME: Final = 0x40
"""Of the port status."""
BAD_FIT: Final = 0x01
TOO_FEW_MARKERS: Final = 0x02
"""Of the tool information."""
_INFORMATION: Final = {
    PoseStatus.INVALID: BAD_FIT,
    PoseStatus.HIGH_ERROR: BAD_FIT,
    PoseStatus.LOW_RELIABILITY: BAD_FIT,
    PoseStatus.MISSING: TOO_FEW_MARKERS,
    PoseStatus.OUT_OF_VIEW: TOO_FEW_MARKERS,
}


class HandleState(IntEnum):
    """State of a port handle in a reply: valid, missing or disabled."""

    VALID = 1
    MISSING = 2
    DISABLED = 4


@dataclass(frozen=True)
class ToolReport:
    """One tool.

    Args:
        handle: its port handle.
        state: whether there is a pose.
        port_status: bits.
        frame: its number, 32 bits.
        information: bits, why there is no pose.
        markers_used: how many of its markers the pose comes from.
        quaternion: of R_world_tool, scalar first and not negative; None: there is none.
        translation_mm: the tool's origin in the world [mm].
        error_mm: how far it may be off [mm].
        markers_mm: where the pose puts its markers in the world; empty: not known, or no pose.
    """

    handle: int
    state: HandleState
    port_status: int
    frame: int
    information: int = 0
    markers_used: int = 0
    quaternion: tuple[float, ...] | None = None
    translation_mm: tuple[float, ...] | None = None
    error_mm: float = 0.0
    markers_mm: tuple[tuple[float, ...], ...] = ()


def report(
    port: PortHandle,
    pose: ToolPose | None,
    frame: int,
    *,
    out_of_volume: bool,
    markers_mm: Array | None = None,
) -> ToolReport:
    """Return the report of the tool behind a handle.

    Only poses that are OK are given; with ``out_of_volume`` those, too, that are good but outside
    of the volume. What is uncertain or does not fit is missing, and the information says so.

    Args:
        port: the handle.
        pose: the newest pose of its tool; None: there is none, or none that is new.
        frame: number of the frame.
        out_of_volume: whether the client wants poses outside of the volume.
        markers_mm: the tool's markers in its own coordinates, shape (M, 3) [mm]; None: not known.
    """
    status = port.status
    if not port.enabled:
        return ToolReport(port.handle, HandleState.DISABLED, status, frame)
    if pose is None:
        return ToolReport(port.handle, HandleState.MISSING, status, frame)
    reported = pose.status is PoseStatus.OK
    if pose.status is PoseStatus.OUT_OF_VOLUME:
        status |= OUT_OF_VOLUME
        reported = out_of_volume
    information = _INFORMATION.get(pose.status, 0)
    rotation, translation = pose.rotation, pose.translation_mm
    if reported and rotation is not None and translation is not None:
        if np.isfinite(rotation).all() and np.abs(translation).max() <= MAX_MM:
            return ToolReport(
                port.handle,
                HandleState.VALID,
                status,
                frame,
                information,
                pose.markers_used,
                tuple(rotation_quaternion(rotation).tolist()),
                tuple(translation.tolist()),
                error_mm(pose),
                _in_world(rotation, translation, markers_mm),
            )
        # Nothing on the wire can say where it is.
        status |= OUT_OF_VOLUME
    return ToolReport(
        port.handle, HandleState.MISSING, status, frame, information, pose.markers_used
    )


def _in_world(
    rotation: Array, translation_mm: Array, markers_mm: Array | None
) -> tuple[tuple[float, ...], ...]:
    if markers_mm is None:
        return ()
    positions = markers_mm[:MAX_MARKERS] @ rotation.T + translation_mm
    return tuple(map(tuple, positions.tolist())) if np.abs(positions).max() <= MAX_MM else ()


def error_mm(pose: ToolPose) -> float:
    """Return the error of a pose as this protocol has it: one length, at most MAX_UNIT [mm].

    The standard deviation of the tool's origin in space, larger by as much as the readings
    disagree by more than their noise. A pose that does not say has the largest.
    """
    variance = np.nan if pose.covariance is None else float(np.trace(pose.covariance[3:, 3:]))
    if not variance >= 0.0:
        return MAX_UNIT
    error = math.sqrt(variance) * max(1.0, pose.residual_sigma or 0.0)
    return min(error, MAX_UNIT) if math.isfinite(error) else MAX_UNIT


def tracking_text(reports: Sequence[ToolReport], system_status: int, options: ReplyOption) -> str:
    """Return the text of a reply to TX, without its checksum."""
    tools = "".join(f"{one.handle:02X}{_text_record(one, options)}\n" for one in reports)
    strays = "00" if ReplyOption.STRAYS in options else ""
    return f"{len(reports):02X}{tools}{strays}{system_status:04X}"


def _text_record(one: ToolReport, options: ReplyOption) -> str:
    parts = []
    if ReplyOption.TRANSFORMS in options:
        parts += [_transform(one), f"{one.port_status:08X}", f"{one.frame:08X}"]
    if ReplyOption.INFORMATION in options:
        markers = ("3" * one.markers_used)[:MAX_MARKERS].rjust(MAX_MARKERS, "0")
        parts += [f"{one.information:02X}", markers]
    if ReplyOption.SINGLE_STRAY in options:
        parts.append("DISABLED" if one.state is HandleState.DISABLED else "MISSING")
    if ReplyOption.MARKERS in options:
        parts.append(_text_markers(one))
    return "".join(parts)


def _transform(one: ToolReport) -> str:
    if one.quaternion is None or one.translation_mm is None:
        return one.state.name
    numbers = "".join(unit(value) for value in one.quaternion)
    return numbers + millimetres(one.translation_mm) + unit(one.error_mm)


def _text_markers(one: ToolReport) -> str:
    count = len(one.markers_mm)
    outside = (1 << count) - 1 if one.port_status & OUT_OF_VOLUME else 0
    digits = -(-count // 4)
    bits = f"{outside:0{digits}X}" if digits else ""
    return f"{count:02X}{bits}" + "".join(millimetres(position) for position in one.markers_mm)


def tracking_binary(
    reports: Sequence[ToolReport], system_status: int, options: ReplyOption
) -> bytes:
    """Return the body of a reply to BX, without start and checksums."""
    body = bytearray([len(reports)])
    for one in reports:
        body += bytes((one.handle, one.state))
        if one.state is not HandleState.DISABLED:
            body += _binary_record(one, options)
    if ReplyOption.STRAYS in options:
        body.append(0)
    return bytes(body) + struct.pack("<H", system_status)


def _binary_record(one: ToolReport, options: ReplyOption) -> bytes:
    data = b""
    if ReplyOption.TRANSFORMS in options:
        if one.quaternion is not None and one.translation_mm is not None:
            data += struct.pack("<8f", *one.quaternion, *one.translation_mm, one.error_mm)
        data += struct.pack("<II", one.port_status, one.frame)
    if ReplyOption.INFORMATION in options:
        used = min(one.markers_used, MAX_MARKERS)
        # Half a byte for each marker, that of the first marker last.
        markers = int("3" * used or "0", 16).to_bytes(MAX_MARKERS // 2, "big")
        data += bytes((one.information,)) + markers
    if ReplyOption.SINGLE_STRAY in options:
        data += b"\0"
    if ReplyOption.MARKERS in options:
        data += _binary_markers(one)
    return data


def _binary_markers(one: ToolReport) -> bytes:
    count = len(one.markers_mm)
    outside = (1 << count) - 1 if one.port_status & OUT_OF_VOLUME else 0
    positions = (struct.pack("<3f", *position) for position in one.markers_mm)
    return bytes((count,)) + outside.to_bytes(-(-count // 8), "little") + b"".join(positions)


RECOVERABLE: Final = 0x0008
"""Of the system status: no new poses come."""


def tracking(state: ClientState, text: str, *, binary: bool) -> bytes:
    """Return the whole reply to TX, or to BX if ``binary``; raises CommandError."""
    options = reply_option(text)
    view = state.view()
    state.ports.poll_tools(view.tools)
    state.reported = view.sequence
    frame = max(view.sequence - state.first_frame, 0) & 0xFFFFFFFF
    reports = [_report(port, view, frame, options) for port in state.ports if port.initialised]
    status = state.ports.changes | (0 if view.fresh else RECOVERABLE)
    if binary:
        return binary_reply(tracking_binary(reports, status, options))
    return text_reply(tracking_text(reports, status, options))


def _report(port: PortHandle, view: PoseView, frame: int, options: ReplyOption) -> ToolReport:
    tool = port.tool or ""
    return report(
        port,
        view.pose(tool),
        frame,
        out_of_volume=ReplyOption.OUT_OF_VOLUME in options,
        markers_mm=view.markers(tool) if ReplyOption.MARKERS in options else None,
    )
