"""CSV and Parquet: one row for each point, track and tool in each frame."""

import csv
import json
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from compute.flags import flag_names
from compute.reconstruction.point_batch import PointFlag
from compute.tracking.track_batch import TrackFlag, TrackState
from compute.transform import rotation_quaternion
from service.api.exports.motion_table import NO_MARKER, MotionTable
from service.api.exports.optional_dependencies import import_optional

_ROWS: Final = 10_000
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
        "flags": [_flags(PointFlag, one) for one in points.flags.tolist()],
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
        "flags": [_flags(TrackFlag, one) for one in tracks.flags.tolist()],
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


@lru_cache
def _flags(kind: type[PointFlag | TrackFlag], flags: int) -> str:
    return " ".join(flag_names(kind(flags)))


def write_csv(table: MotionTable, path: Path) -> None:
    """Write all of a table; numbers with as many digits as give the same number again."""
    columns = tidy_columns(table)
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        for first in range(0, len(columns["frame"]), _ROWS):
            part = [
                _cells(column[first : first + _ROWS], empty=name in NUMBERS)
                for name, column in columns.items()
            ]
            writer.writerows(zip(*part, strict=True))


def _cells(column: NDArray[Any], *, empty: bool) -> list[Any]:
    values: list[Any] = column.tolist()
    if not empty or np.isfinite(column).all():
        return values
    return [value if value == value else "" for value in values]


def write_parquet(table: MotionTable, path: Path) -> None:
    """Write all of a table; raises MissingLibrary."""
    pa, parquet = import_optional("pyarrow"), import_optional("pyarrow.parquet")
    columns = tidy_columns(table)
    arrays = [_array(pa, name, column) for name, column in columns.items()]
    facts = {
        "device": table.device,
        "rate_hz": table.rate_hz,
        "frames": len(table),
        "lengths": "mm",
        "times": "ns",
        **table.notes,
    }
    whole = pa.Table.from_arrays(arrays, names=list(columns)).replace_schema_metadata(
        {"lumiline": json.dumps(facts)}
    )
    parquet.write_table(whole, path)


def _array(pa: Any, name: str, column: Any) -> Any:
    if name in TEXTS:
        return pa.array(column.tolist(), pa.string()).dictionary_encode()
    # What is no number is null: it is not known, and no result of a computation.
    return pa.array(column, from_pandas=name in NUMBERS)
