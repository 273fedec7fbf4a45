"""Sequence metafile (.igs.mha): transforms of tools, frame by frame, as PLUS and 3D Slicer read it.

A MetaImage header without an image: each frame's transforms with their status and timestamp are
fields of it.
"""

from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from compute.pose.rigid_body import PoseStatus
from service.api.exports.motion_table import MotionTable
from service.pipeline.transform_names import wire_name

Array = NDArray[np.float64]

STATUS: Final = {
    # Words that PLUS knows; what is uncertain it has no word for.
    PoseStatus.HIGH_ERROR.value: "INVALID",
    PoseStatus.LOW_RELIABILITY.value: "INVALID",
    PoseStatus.UNKNOWN.value: "MISSING",
}
_HEAD: Final = """\
ObjectType = Image
NDims = 3
AnatomicalOrientation = RAI
BinaryData = True
BinaryDataByteOrderMSB = False
CenterOfRotation = 0 0 0
CompressedData = False
DimSize = 0 0 {frames}
Kinds = domain domain list
ElementNumberOfChannels = 1
ElementSpacing = 1 1 1
ElementType = MET_UCHAR
Offset = 0 0 0
TransformMatrix = 1 0 0 0 1 0 0 0 1
UltrasoundImageOrientation = MF
UltrasoundImageType = BRIGHTNESS
LumilineDevice = {device}
LumilineRateHz = {rate}
LumilineStartHostNs = {start}
"""


def write_sequence(table: MotionTable, path: Path) -> None:
    """Write the transforms of all tools, in millimetres; the identity where there is no pose.

    Timestamps are seconds on the device's clock since the first exposure.

    Raises:
        InvalidParameter: there is no tool, or no frame.
    """
    if not table.tools:
        raise InvalidParameter(
            "a sequence metafile holds transforms of tools, and there is no tool: give them with "
            "--tools"
        )
    if not len(table):
        raise InvalidParameter("there is no frame to export")
    transforms, status = _by_frame(table)
    names = [f"{_frame_name(name)}Transform" for name in table.tools]
    times = table.time_s.tolist()
    with path.open("w", encoding="utf-8", newline="") as file:
        file.write(
            _HEAD.format(
                frames=len(table),
                device=table.device,
                rate=f"{table.rate_hz:.9g}",
                start=int(table.host_ns[0]),
            )
        )
        for frame, (sequence, time_s) in enumerate(
            zip(table.sequence.tolist(), times, strict=True)
        ):
            start = f"Seq_Frame{frame:04d}_"
            file.write(f"{start}FrameNumber = {sequence}\n")
            for tool, name in enumerate(names):
                numbers = " ".join(map(repr, transforms[tool, frame].ravel().tolist()))
                file.write(f"{start}{name} = {numbers}\n")
                file.write(f"{start}{name}Status = {status[tool][frame]}\n")
            file.write(f"{start}Timestamp = {time_s:.9f}\n")
            file.write(f"{start}UnfilteredTimestamp = {time_s:.9f}\n")
            file.write(f"{start}ImageStatus = INVALID\n")
        file.write("ElementDataFile = LOCAL\n")


def _frame_name(tool: str) -> str:
    """Return the transform's name, with a capital at both frames, as these files have it."""
    full = wire_name(tool, None).full
    return full[:1].upper() + full[1:]


def _by_frame(table: MotionTable) -> tuple[Array, list[list[str]]]:
    """Return transforms (tools, F, 4, 4) and the status of each."""
    poses = table.poses
    shape = (len(table.tools), len(table))
    transforms = np.tile(np.eye(4), (*shape, 1, 1))
    there = np.isfinite(poses.translation_mm).all(axis=1)
    at = (poses.tool[there], poses.frame[there])
    transforms[*at, :3, :3] = poses.rotation[there]
    transforms[*at, :3, 3] = poses.translation_mm[there]
    status = [["MISSING"] * len(table) for _ in table.tools]
    for tool, frame, word in zip(
        poses.tool.tolist(), poses.frame.tolist(), poses.status.tolist(), strict=True
    ):
        status[tool][frame] = STATUS.get(word, word)
    return transforms, status
