"""Motion table of a captured stream: a file with one websocket message a line."""

import json
from collections.abc import Iterator
from enum import IntFlag
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from compute.pose.rigid_body import PoseStatus, ToolPose
from compute.reconstruction.point_batch import PointFlag
from compute.tracking.track_batch import TrackFlag, TrackState
from service.api.exports.motion_table import (
    MotionTable,
    PointRows,
    TrackRows,
    stack_or_nan,
    standard_deviations,
)
from service.api.exports.table_builder import TableBuilder

SUFFIXES: Final = (".jsonl", ".ndjson", ".json")

Array = NDArray[np.float64]


def table_from_stream(path: Path) -> MotionTable:
    """Return what the messages of a stream hold: points, tracks and tools, as far as they do.

    Messages of other kinds are left out. What is not sent (residuals of tracks, ...) is NaN.

    Raises:
        InvalidParameter: the file cannot be read, a line is no message, there is no frame, the
            frames are of several devices or not in order.
    """
    builder: TableBuilder | None = None
    device, last = "", -1
    try:
        with path.open(encoding="utf-8") as file:
            for number, line in enumerate(file, start=1):
                try:
                    for message in _frames(line):
                        device = device or str(message["device_id"])
                        builder = builder or TableBuilder(device, 0.0, ())
                        if message["device_id"] != device or message["sequence"] <= last:
                            raise InvalidParameter(
                                f"{path} has frame {message['sequence']} of {message['device_id']} "
                                f"behind frame {last} of {device}, in line {number}; an export is "
                                "of one device, from one connection, in order"
                            )
                        last = int(message["sequence"])
                        _add(builder, message)
                except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
                    raise InvalidParameter(
                        f"{path} has no message of a stream in line {number}: "
                        f"{type(error).__name__}: {error}"
                    ) from error
    except OSError as error:
        raise InvalidParameter(f"{path} cannot be read: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise InvalidParameter(f"{path} is not text in UTF-8: {error}") from error
    if builder is None:
        raise InvalidParameter(f"{path} has no frame in it")
    return builder.build()


def _frames(line: str) -> Iterator[dict[str, Any]]:
    """Yield the frames of a line: none, one, or a bundle's."""
    if not line.strip():
        return
    message = json.loads(line)
    if message["type"] == "frame":
        yield message
    elif message["type"] == "frames":
        for frame in message["frames"]:
            yield {"device_id": message["device_id"], **frame}


def _add(builder: TableBuilder, message: dict[str, Any]) -> None:
    index = len(builder)
    points, tracks = message.get("points") or [], message.get("tracks") or []
    builder.add_frame(
        int(message["sequence"]),
        int(message["device_ns"]),
        int(message["exposure_ns"]),
        message["marker"],
    )
    builder.points.append(
        PointRows(
            np.full(len(points), index),
            _stack(points, "position_mm", (3,)),
            standard_deviations(_stack(points, "covariance_mm2", (3, 3))),
            _stack(points, "residual_sigma", ()),
            np.array([_flags(PointFlag, one["flags"]) for one in points], np.int32),
        )
    )
    builder.tracks.append(
        TrackRows(
            np.full(len(tracks), index),
            np.array([one["id"] for one in tracks], np.int64),
            np.array([-1 if one["marker"] is None else one["marker"] for one in tracks], np.int32),
            np.array([TrackState[one["state"].upper()] for one in tracks], np.int8),
            np.array([_flags(TrackFlag, one["flags"]) for one in tracks], np.int32),
            _stack(tracks, "position_mm", (3,)),
            standard_deviations(_stack(tracks, "covariance_mm2", (3, 3))),
            _stack(tracks, "velocity_mm_s", (3,)),
        )
    )
    builder.poses += [(index, _pose(tool, message)) for tool in message.get("tools") or []]


def _pose(tool: dict[str, Any], message: dict[str, Any]) -> ToolPose:
    return ToolPose(
        str(tool["tool_id"]),
        PoseStatus(tool["status"]),
        tool["reason"],
        int(message["exposure_ns"]),
        int(message["sequence"]),
        rotation=_array(tool["rotation"], (3, 3)),
        translation_mm=_array(tool["translation_mm"], (3,)),
        covariance=_array(tool["covariance"], (6, 6)),
        tip_mm=_array(tool["tip_mm"], (3,)),
        tip_covariance_mm2=_array(tool["tip_covariance_mm2"], (3, 3)),
        residual_sigma=tool["residual_sigma"],
    )


def _stack(items: list[dict[str, Any]], name: str, shape: tuple[int, ...]) -> Array:
    return stack_or_nan((_array(one[name], shape) for one in items), shape)


def _array(values: Any, shape: tuple[int, ...]) -> Array | None:
    if values is None:
        return None
    found = np.array(values, np.float64)
    if found.shape != shape:
        raise ValueError(f"numbers of the shape {found.shape}; there must be {shape}")
    return found


def _flags(kind: type[IntFlag], names: list[str]) -> int:
    return sum(int(kind[name.upper().replace("-", "_")]) for name in names)
