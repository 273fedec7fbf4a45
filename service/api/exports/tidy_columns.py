"""Columns of tabular files: one row for each point, track and tool in each frame."""

from collections.abc import Callable
from functools import lru_cache
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from compute.camera.rotation import rotation_quaternion
from compute.flags import flag_names
from compute.reconstruction.point_batch import PointFlag
from compute.tracking.track_batch import TrackFlag, TrackState
from service.api.exports.motion_table import NO_MARKER, MotionTable

TEXTS: Final = ("kind", "label", "status", "flags")
WHOLE: Final = ("frame", "sequence", "device_ns", "host_ns", "strobe_marker")
_VECTORS: Final = {
    "position_mm": ("x_mm", "y_mm", "z_mm"),
    "sd_mm": ("sd_x_mm", "sd_y_mm", "sd_z_mm"),
    "velocity_mm_s": ("vx_mm_s", "vy_mm_s", "vz_mm_s"),
    "quaternion": ("qw", "qx", "qy", "qz"),
    "tip_mm": ("tip_x_mm", "tip_y_mm", "tip_z_mm"),
    "residual_sigma": ("residual_sigma",),
}
NUMBERS: Final = tuple(name for names in _VECTORS.values() for name in names)
COLUMNS: Final = (*WHOLE, *TEXTS, *NUMBERS)


def tidy_columns(table: MotionTable) -> dict[str, NDArray[Any]]:
    """Return the columns COLUMNS, of one length, ordered by frames.

    ``kind`` is point, track or tool. ``strobe_marker`` is -1 where all were lit. Numbers are NaN
    where there is none: a tool has a row in every frame, with or without a pose.
    """
    parts = [_points(table), _tracks(table), _tools(table)]
    frame = np.concatenate([part["frame"] for part in parts])
    order = np.argsort(frame, kind="stable")
    frame = frame[order]
    found: dict[str, NDArray[Any]] = {
        "frame": frame,
        "sequence": table.sequence[frame],
        "device_ns": table.device_ns[frame],
        "host_ns": table.host_ns[frame],
        "strobe_marker": table.marker[frame],
    }
    for name in TEXTS:
        found[name] = np.concatenate([np.asarray(part[name], np.str_) for part in parts])[order]
    for vector, names in _VECTORS.items():
        whole = np.concatenate(
            [part.get(vector, np.full((len(part["frame"]), len(names)), np.nan)) for part in parts]
        )
        for axis, name in enumerate(names):
            found[name] = whole[order, axis]
    return {name: found[name] for name in COLUMNS}


def _points(table: MotionTable) -> dict[str, Any]:
    points = table.points
    marker = table.marker[points.frame].tolist()
    return {
        "frame": points.frame,
        "kind": ["point"] * len(marker),
        "label": ["" if one == NO_MARKER else f"marker-{one}" for one in marker],
        "status": np.where(np.isfinite(points.position_mm[:, 0]), "OK", "MISSING"),
        "flags": _words(points.flags, _point_flags),
        "position_mm": points.position_mm,
        "sd_mm": points.sd_mm,
        "residual_sigma": points.residual_sigma[:, None],
    }


def _tracks(table: MotionTable) -> dict[str, Any]:
    tracks = table.tracks
    return {
        "frame": tracks.frame,
        "kind": ["track"] * len(tracks.frame),
        "label": [f"track-{one}" for one in tracks.identity.tolist()],
        "status": [TrackState(one).name for one in tracks.state.tolist()],
        "flags": _words(tracks.flags, _track_flags),
        "position_mm": tracks.position_mm,
        "sd_mm": tracks.sd_mm,
        "velocity_mm_s": tracks.velocity_mm_s,
    }


def _tools(table: MotionTable) -> dict[str, Any]:
    poses = table.poses
    quaternion = np.full((len(poses.frame), 4), np.nan)
    there = np.isfinite(poses.rotation).all(axis=(1, 2))
    quaternion[there] = rotation_quaternion(poses.rotation[there])
    return {
        "frame": poses.frame,
        "kind": ["tool"] * len(poses.frame),
        "label": [table.tools[one] for one in poses.tool.tolist()],
        "status": poses.status,
        "flags": [""] * len(poses.frame),
        "position_mm": poses.translation_mm,
        "sd_mm": poses.sd_mm,
        "quaternion": quaternion,
        "tip_mm": poses.tip_mm,
        "residual_sigma": poses.residual_sigma[:, None],
    }


def _words(flags: NDArray[np.int32], words: Callable[[int], str]) -> list[str]:
    return [words(one) for one in flags.tolist()]


@lru_cache
def _point_flags(flags: int) -> str:
    return " ".join(flag_names(PointFlag(flags)))


@lru_cache
def _track_flags(flags: int) -> str:
    return " ".join(flag_names(TrackFlag(flags)))
