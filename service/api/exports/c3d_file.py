"""C3D: trajectories and rotations of tools in the binary format of motion capture.

C3D has single-precision numbers, one rate, and no times. Frames that were lost are gaps, so that
the rate holds, and the analog channel TIME_OFF_NOMINAL_US has by how much each exposure was later
than the rate says.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from compute.pose.rigid_body import PoseStatus
from service.api.exports.motion_table import MotionTable
from service.api.exports.optional_dependencies import import_optional
from service.api.exports.trajectories import Trajectory

RESIDUAL_STEP_MM: Final = 0.01
"""The format keeps the residual of a point in one byte."""
MAX_STEPS: Final = 255
TIME_CHANNEL: Final = "TIME_OFF_NOMINAL_US"
MAX_FRAMES: Final = 65_535
"""The header counts frames in 16 bits, and readers keep to that."""
_MAX_GAPS: Final = 20
"""Largest number of frames of the file, relative to the frames that there are."""

Array = NDArray[np.float64]


def write_c3d(table: MotionTable, found: Sequence[Trajectory], path: Path) -> None:
    """Write trajectories, and where there are tools the rotations of them.

    Raises:
        MissingLibrary: ezc3d is not installed.
        InvalidParameter: there is no frame, there are more than MAX_FRAMES, or most of them were
            lost: nothing of one rate.
    """
    ezc3d = import_optional("ezc3d")
    place = _places(table)
    frames = int(place[-1]) + 1
    file = ezc3d.c3d()
    _points(file, table, found, place, frames)
    _times(file, table, place, frames)
    if table.tools:
        _rotations(file, table, place, frames)
    facts = {"DEVICE": table.device, "START_HOST_NS": str(int(table.host_ns[0]))}
    facts |= {name.upper(): value for name, value in table.notes.items() if value}
    for name, value in facts.items():
        file.add_parameter("LUMILINE", name, value)
    file.write(str(path))


def _places(table: MotionTable) -> NDArray[np.int64]:
    """Return where in the file each frame is, from 0."""
    if not len(table):
        raise InvalidParameter("there is no frame to export")
    place: NDArray[np.int64] = table.sequence - table.sequence[0]
    if place[-1] >= _MAX_GAPS * len(table):
        raise InvalidParameter(
            f"of the {int(place[-1]) + 1} exposures from the first frame to the last only "
            f"{len(table)} are there; C3D has one rate and would be gaps for the most part: "
            "export to .csv, .parquet or .trc"
        )
    if place[-1] >= MAX_FRAMES:
        raise InvalidParameter(
            f"there are {int(place[-1]) + 1} exposures from the first frame to the last; C3D holds "
            f"{MAX_FRAMES}: export to .csv, .parquet or .trc"
        )
    return place


def _points(
    file: Any,
    table: MotionTable,
    found: Sequence[Trajectory],
    place: NDArray[np.int64],
    frames: int,
) -> None:
    points = np.full((4, len(found), frames), np.nan)
    points[3] = 1.0
    residuals = np.full((1, len(found), frames), -1.0)
    for index, one in enumerate(found):
        seen = np.flatnonzero(np.isfinite(one.position_mm).all(axis=1))
        points[:3, index, place[seen]] = one.position_mm[seen].T
        steps = np.nan_to_num(one.sd_mm[seen], nan=np.inf) / RESIDUAL_STEP_MM
        # Half a step more: whole steps are kept, and the rest is cut off.
        residuals[0, index, place[seen]] = (
            np.minimum(np.round(steps), MAX_STEPS) + 0.5
        ) * RESIDUAL_STEP_MM
    parameters = _describe(file, "POINT", table.rate_hz, [one.label for one in found], "mm")
    # Below zero: numbers are single-precision as they stand; its size is the residuals' step.
    parameters["SCALE"]["value"] = [-RESIDUAL_STEP_MM]
    file["data"]["points"] = points
    file["data"]["meta_points"]["residuals"] = residuals
    file["data"]["meta_points"]["camera_masks"] = np.zeros((7, len(found), frames), np.bool_)


def _describe(file: Any, group: str, rate_hz: float, labels: list[str], unit: str) -> Any:
    parameters = file["parameters"][group]
    for name, value in (("RATE", rate_hz), ("UNITS", unit)):
        parameters[name]["value"] = [value]
    parameters["LABELS"]["value"] = labels
    return parameters


def _times(file: Any, table: MotionTable, place: NDArray[np.int64], frames: int) -> None:
    nominal_s = place / table.rate_hz if table.rate_hz else np.zeros(len(place))
    late = np.zeros((1, 1, frames))
    late[0, 0, place] = (table.time_s - nominal_s) * 1e6
    _describe(file, "ANALOG", table.rate_hz, [TIME_CHANNEL], "us")
    file["data"]["analogs"] = late


def _rotations(file: Any, table: MotionTable, place: NDArray[np.int64], frames: int) -> None:
    """Write T_world_tool of each tool where its pose is OK."""
    poses = table.poses
    rotations = np.full((4, 4, len(table.tools), frames), np.nan)
    good = np.flatnonzero(poses.status == PoseStatus.OK.value)
    where = (poses.tool[good], place[poses.frame[good]])
    matrix = np.tile(np.eye(4), (len(good), 1, 1))
    matrix[:, :3, :3] = poses.rotation[good]
    matrix[:, :3, 3] = poses.translation_mm[good]
    rotations[:, :, where[0], where[1]] = matrix.transpose(1, 2, 0)
    file["data"]["rotations"] = rotations
    for name, value in (
        ("USED", [len(table.tools)]),
        ("RATE", [table.rate_hz]),
        ("RATIO", [1]),
        ("LABELS", list(table.tools)),
    ):
        file.add_parameter("ROTATION", name, value)
