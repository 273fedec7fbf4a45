"""The HDF5 layout of recordings: groups, datasets and their types.

Version 3. Attributes of the root: ``format``, ``version``, ``description`` (the device's
description as JSON) and ``provenance`` (a JSON object: who wrote it, when, with which settings).
Texts are UTF-8 of fixed length: HDF5 has a checksum over them. It has none over texts of variable
length, and a damaged length of one makes it loop for ever.

- ``frames``: a group with one row for each frame in the datasets of ``COLUMNS`` and, unless only
  results were recorded, in ``lines``, uint16, shape (frames, sensors, pixels). A marker of -1
  stands for none. ``active_calibration`` is the row of ``active_calibrations/rows`` that the
  results were made with, -1: none. ``peaks_end`` and ``points_end`` count the rows of ``peaks``
  and ``points`` up to and with this frame. ``checksum`` is the CRC-32 of the frame's FRAME row and
  its lines, ``results_checksum`` that of its rows of peaks and points.
- ``peaks``, ``points``: live results, one row each; ``frame`` is the row of their frame.
- ``active_calibrations``: calibrations and correction tables, whole: ``bytes``, and ``rows`` that
  say where in them a JSON document and a table's HDF5 file begin and how long they are.
  ``checksum`` is the CRC-32 of the row's number, these extents, the document and the table.
- ``state``: two rows, written in turn at each flush; that of the larger ``number`` whose
  checksum is right holds. Rows of the other datasets beyond what it counts are not there yet.
"""

import zlib
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from hardware.driver import DeviceDescription

FORMAT: Final = "lumiline-recording"
VERSION: Final = 3
COLUMNS: Final[dict[str, np.dtype[Any]]] = {
    "sequence": np.dtype(np.int64),
    "exposure_device_ns": np.dtype(np.int64),
    "exposure_host_ns": np.dtype(np.int64),
    "marker": np.dtype(np.int32),
    "flags": np.dtype(np.uint32),
    "active_calibration": np.dtype(np.int32),
    "peaks_end": np.dtype(np.int64),
    "points_end": np.dtype(np.int64),
    "checksum": np.dtype(np.uint32),
    "results_checksum": np.dtype(np.uint32),
}
NO_MARKER: Final = -1
NO_CALIBRATION_ROW: Final = -1
CHUNK_FRAMES: Final = 32
"""Frames of one chunk of lines, at most."""
CHUNK_BYTES: Final = 2**22
"""Largest chunk of lines of more than one frame."""

FRAME: Final = np.dtype(
    [
        ("sequence", "<i8"),
        ("exposure_device_ns", "<i8"),
        ("exposure_host_ns", "<i8"),
        ("marker", "<i4"),
        ("flags", "<u4"),
        ("active_calibration", "<i4"),
        ("peaks", "<u4"),
        ("points", "<u4"),
    ]
)
"""A frame without its lines; ``peaks`` and ``points`` are how many it has."""
PEAK: Final = np.dtype(
    [
        ("frame", "<i8"),
        ("sensor", "<i4"),
        ("flags", "<i4"),
        ("position_px", "<f8"),
        ("sigma_px", "<f4"),
        ("amplitude", "<f4"),
        ("width_px", "<f4"),
        ("reduced_chi2", "<f4"),
        ("covariance_px2", "<f4", (3,)),
    ]
)
"""A peak: of which row of ``frames`` and which sensor (from 0), and the members of PeakBatch."""
CALIBRATION_EXTENT: Final = np.dtype(
    [
        ("document_start", "<i8"),
        ("document_bytes", "<i8"),
        ("table_start", "<i8"),
        ("table_bytes", "<i8"),
        ("checksum", "<u4"),
    ]
)
"""Where a document and its table lie in ``active_calibrations/bytes``; one of 0 bytes is none."""
STATE: Final = np.dtype(
    [
        ("number", "<i8"),
        ("frames", "<i8"),
        ("peaks", "<i8"),
        ("points", "<i8"),
        ("active_calibrations", "<i8"),
        ("duration_ns", "<i8"),
        ("missing", "<i8"),
        ("dropped_compute", "<i8"),
        ("dropped_writer", "<i8"),
        ("refused", "<i8"),
        ("complete", "<i4"),
        ("reason_bytes", "<i4"),
        ("reason", "u1", (400,)),
        ("checksum", "<u4"),
    ]
)


@cache
def point_dtype(sensors: int) -> np.dtype[Any]:
    """Return the type of a row of ``points``: the frame and the members of PointBatch."""
    return np.dtype(
        [
            ("frame", "<i8"),
            ("position_mm", "<f8", (3,)),
            ("covariance_mm2", "<f8", (3, 3)),
            ("chi2", "<f8"),
            ("flags", "<i4"),
            ("used", "u1", (sensors,)),
        ]
    )


@dataclass(frozen=True)
class RecordingState:
    """State of a recording at a flush: rows written, frames lost, reason of the end.

    Args:
        frames: frames that are in the file.
        peaks: rows of peaks.
        points: rows of points.
        active_calibrations: calibrations with their tables.
        duration_ns: from the first exposure to the last, on the device's clock [ns].
        missing: sequence numbers missing between the first frame and the last, for whatever
            reason.
        dropped_compute: frames dropped because the live pipeline did not keep up; those behind
            the last frame are not among the missing ones.
        dropped_writer: frames dropped because the writer did not keep up; likewise.
        refused: frames that did not follow the one before (the device's count or clock went
            back), and are not in the file.
        complete: whether the writer closed the file; False: it still writes, or ended before.
        reason: why it ended; empty while it is written.
    """

    frames: int = 0
    peaks: int = 0
    points: int = 0
    active_calibrations: int = 0
    duration_ns: int = 0
    missing: int = 0
    dropped_compute: int = 0
    dropped_writer: int = 0
    refused: int = 0
    complete: bool = False
    reason: str = ""


@dataclass(frozen=True)
class Losses:
    """Frames lost before or in the writer, as in RecordingState."""

    dropped_compute: int = 0
    dropped_writer: int = 0
    refused: int = 0


NO_LOSSES: Final = Losses()

_NUMBERS: Final = tuple(
    name
    for name in STATE.names or ()
    if name not in ("number", "reason", "reason_bytes", "checksum")
)


def pack_state(state: RecordingState, number: int) -> NDArray[np.void]:
    """Return the state as a row of STATE, shape (), with its checksum."""
    row = np.zeros((), STATE)
    row["number"] = number
    for name in _NUMBERS:
        row[name] = getattr(state, name)
    text = state.reason.encode()[: STATE["reason"].shape[0]]
    row["reason_bytes"] = len(text)
    row["reason"][: len(text)] = np.frombuffer(text, np.uint8)
    row["checksum"] = _state_checksum(row)
    return row


def unfinished_path(path: Path, pid: int) -> Path:
    """Return the temporary path of a recording until it can be read."""
    return path.with_name(f".{path.name}.{pid}.new")


def unpack_state(rows: NDArray[np.void]) -> tuple[RecordingState, int] | None:
    """Return the newest valid state of rows of STATE, and its number; None: none is valid."""
    intact = [row for row in rows if int(row["checksum"]) == _state_checksum(row)]
    if not intact:
        return None
    row = max(intact, key=lambda one: int(one["number"]))
    values: dict[str, Any] = {name: int(row[name]) for name in _NUMBERS}
    values["complete"] = bool(values["complete"])
    text = row["reason"][: int(row["reason_bytes"])].tobytes().decode(errors="replace")
    return RecordingState(**values, reason=text), int(row["number"])


def _state_checksum(row: Any) -> int:
    return zlib.crc32(row.tobytes()[: -STATE["checksum"].itemsize])


def frame_checksums(rows: NDArray[np.void], lines: NDArray[np.uint16] | None) -> NDArray[np.uint32]:
    """Return the checksums of frames, shape (F,).

    Args:
        rows: of FRAME, shape (F,), contiguous.
        lines: their lines, shape (F, S, P), contiguous; None: there are none.
    """
    headers = rows.view(np.uint8).reshape(len(rows), FRAME.itemsize)
    if lines is None:
        return np.array([zlib.crc32(head.data) for head in headers], np.uint32)
    both = zip(headers, lines, strict=True)
    return np.array(
        [zlib.crc32(line.data, zlib.crc32(head.data)) for head, line in both], np.uint32
    )


def result_checksums(
    rows: NDArray[np.void], peaks: NDArray[np.void], points: NDArray[np.void]
) -> NDArray[np.uint32]:
    """Return the checksums of the results of frames, shape (F,).

    Args:
        rows: of FRAME, shape (F,).
        peaks: the peaks of all of them in order.
        points: the points of all of them in order.
    """
    checksums = np.zeros(len(rows), np.uint32)
    peak = point = 0
    counts = zip(rows["peaks"].tolist(), rows["points"].tolist(), strict=True)
    for number, (of_peaks, of_points) in enumerate(counts):
        if of_peaks or of_points:
            first = zlib.crc32(peaks[peak : peak + of_peaks].tobytes())
            checksums[number] = zlib.crc32(points[point : point + of_points].tobytes(), first)
            peak, point = peak + of_peaks, point + of_points
    return checksums


def calibration_checksum(row: int, extent: NDArray[np.void], document: bytes, table: bytes) -> int:
    """Return the checksum of an active calibration.

    Args:
        row: its number.
        extent: of CALIBRATION_EXTENT, shape (); its ``checksum`` does not count.
        document: the calibration, JSON.
        table: its table, HDF5; empty without one.
    """
    head = row.to_bytes(8, "little") + extent.tobytes()[: -CALIBRATION_EXTENT["checksum"].itemsize]
    return zlib.crc32(table, zlib.crc32(document, zlib.crc32(head)))


@dataclass(frozen=True)
class RecordingInfo:
    """Contents and provenance of a recording.

    Args:
        description: the recorded device.
        frames: number of frames.
        duration_s: from the first exposure to the last, on the device's clock [s].
        lost: exposures missing between the first frame and the last.
        complete: whether the writer closed it; False while it is written, and after a crash.
        lines: whether it holds lines.
        results: whether it holds peaks and points.
        provenance: who wrote it, when and with which settings.
        state: row counts, frames lost and the reason of the end.
    """

    description: DeviceDescription
    frames: int
    duration_s: float
    lost: int
    complete: bool
    lines: bool
    results: bool
    provenance: dict[str, Any]
    state: RecordingState
