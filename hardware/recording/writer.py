"""RecordingWriter: writes line frames, unchanged, and results to an HDF5 file.

For the layout see ``hardware.recording.layout``. A file can be read up to the last ``flush``
while it is written (HDF5 SWMR), and after a crash of the writer.
"""

import json
import os
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Final, Literal, Self

import h5py
import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from hardware.driver import DeviceDescription
from hardware.line_frame import LineFrame
from hardware.recording.frame_block import FrameBlock, frame_rows, scan_shape
from hardware.recording.layout import (
    CALIBRATION_EXTENT,
    COLUMNS,
    FORMAT,
    FRAME,
    NO_CALIBRATION_ROW,
    NO_LOSSES,
    NO_MARKER,
    PEAK,
    STATE,
    VERSION,
    Losses,
    RecordingState,
    calibration_checksum,
    frame_checksums,
    pack_state,
    point_dtype,
    result_checksums,
    unfinished_path,
)
from hardware.recording.write_buffers import RowBuffer, ScanChunks

_ROWS: Final = 4096
"""Rows per chunk of a column, and maximum number of buffered rows."""


class RecordingWriter:
    """Writes frames of one device to a new file; a context manager.

    Scans are written in whole chunks, past HDF5's own buffers; ``flush`` writes everything else.
    What was appended since the last ``flush`` is lost when the process dies; what it
    acknowledged is not. (It is with the operating system then, not on the disk: a power failure
    may lose the last seconds.)

    Args:
        path: the file; an existing one is replaced.
        description: the device.
        compression: "gzip" takes about a third of the space and fifty times the work, "lzf" half
            of the space and twenty times.
        lines: whether lines are recorded.
        results: whether peaks and points are.
        provenance: a JSON object that is kept with the file.
        exclusive: whether an existing file is kept, and FileExistsError raised.

    Raises:
        InvalidParameter: there is no sensor, they are of different lengths, or nothing is
            recorded.
        OSError: the file cannot be created or written.
    """

    def __init__(
        self,
        path: Path,
        description: DeviceDescription,
        compression: Literal["gzip", "lzf"] | None = None,
        *,
        lines: bool = True,
        results: bool = False,
        provenance: Mapping[str, Any] | None = None,
        exclusive: bool = False,
    ) -> None:
        self._shape = scan_shape(description)
        if not (lines or results):
            raise InvalidParameter("nothing is recorded: neither lines nor results")
        self._description = description
        self._results = results
        self._state = RecordingState()
        self._number = 0
        self._first_sequence = self._last_sequence = -1
        self._first_device_ns = self._last_device_ns = int(np.iinfo(np.int64).min)
        self._lines: ScanChunks | None = None
        self._point = point_dtype(self._shape[0])
        self._waiting = RowBuffer(self._point)
        self._calibration_bytes = 0
        # Under another name until it can be read: an early crash leaves no partial file.
        unready = unfinished_path(path, os.getpid())
        try:
            self._file = h5py.File(unready, "w", libver="latest")
            self._layout(compression, provenance or {}, lines=lines)
            self._file.swmr_mode = True
            self._commit(self._state)
            if exclusive:
                path.hardlink_to(unready)
                unready.unlink()
            else:
                unready.replace(path)
        except BaseException:
            # On a full disk opening, and closing, may fail as well.
            with suppress(AttributeError, OSError, RuntimeError):
                self._file.close()
            unready.unlink(missing_ok=True)
            raise

    def _layout(
        self,
        compression: Literal["gzip", "lzf"] | None,
        provenance: Mapping[str, Any],
        *,
        lines: bool,
    ) -> None:
        attributes = self._file.attrs
        attributes["version"] = VERSION
        for name, text in (
            ("format", FORMAT),
            ("description", json.dumps(asdict(self._description))),
            ("provenance", json.dumps(provenance, allow_nan=False)),
        ):
            attributes[name] = np.bytes_(text.encode())
        group = self._file.create_group("frames")
        for name, kind in COLUMNS.items():
            self._growing(group, name, kind)
        if lines:
            self._lines = ScanChunks(group, self._shape, compression)
        if self._results:
            self._growing(self._file, "peaks", PEAK)
            self._growing(self._file, "points", self._point)
        group = self._file.create_group("active_calibrations")
        self._growing(group, "rows", CALIBRATION_EXTENT, 16)
        self._growing(group, "bytes", np.dtype(np.uint8), 2**16)
        self._file.create_dataset("state", shape=(2,), dtype=STATE, chunks=(2,))

    @staticmethod
    def _growing(group: Any, name: str, dtype: np.dtype[Any], chunk: int = _ROWS) -> None:
        group.create_dataset(name, shape=(0,), maxshape=(None,), dtype=dtype, chunks=(chunk,))

    @property
    def state(self) -> RecordingState:
        """State at the last flush."""
        return self._state

    @property
    def frames(self) -> int:
        """Number of frames that were appended."""
        return self._waiting.frames

    def append(self, frame: LineFrame, calibration_row: int = NO_CALIBRATION_ROW) -> None:
        """Append a frame without results.

        Args:
            frame: the frame.
            calibration_row: of the calibration that was active, as ``put_active_calibration``
                returned it.

        Raises:
            InvalidParameter: it is not of this device: its name, the lines' shape or the marker;
                or its sequence number or device time does not follow the last one's.
        """
        if frame.lines.shape != self._shape or frame.lines.dtype != np.uint16:
            raise InvalidParameter(
                f"the frame's lines are {frame.lines.dtype} of shape {frame.lines.shape}; this "
                f"recording takes uint16 of shape {self._shape}",
                shape=frame.lines.shape,
            )
        if frame.device != self._description.name:
            raise InvalidParameter(
                f"the frame is of device {frame.device!r}; this recording is of "
                f"{self._description.name!r}",
                device=frame.device,
            )
        if frame.marker is not None and not 0 <= frame.marker < self._description.markers:
            raise InvalidParameter(
                f"the frame's marker is {frame.marker}; the device has "
                f"{self._description.markers} strobed markers, counted from 0",
                marker=frame.marker,
            )
        if frame.sequence <= self._last_sequence:
            raise InvalidParameter(
                f"the frame's sequence number is {frame.sequence}; it must be larger than the "
                f"last one, {self._last_sequence}",
                sequence=frame.sequence,
            )
        if frame.exposure_device_ns < self._last_device_ns:
            raise InvalidParameter(
                f"the frame's device time is {frame.exposure_device_ns} ns; it must not be before "
                f"the last one, {self._last_device_ns} ns",
                exposure_device_ns=frame.exposure_device_ns,
            )
        lines = None if self._lines is None else frame.lines[None]
        nothing = np.empty(0, PEAK), np.empty(0, self._point)
        rows = frame_rows([frame])
        rows["active_calibration"] = calibration_row
        self._take(FrameBlock(rows, lines, *nothing))

    def append_block(self, block: FrameBlock) -> int:
        """Append frames with their results; return the number of frames refused.

        Scans or results that are not recorded are ignored. A frame is refused where its sequence
        number does not increase, its device time decreases, or the device has no such marker.
        """
        rows = block.rows
        sequence, device_ns, marker = (
            rows[name] for name in ("sequence", "exposure_device_ns", "marker")
        )
        before = np.maximum.accumulate(np.concatenate(([self._last_sequence], sequence)))[:-1]
        earlier = np.maximum.accumulate(np.concatenate(([self._last_device_ns], device_ns)))[:-1]
        lit = (marker >= NO_MARKER) & (marker < max(self._description.markers, 0))
        valid = (sequence > before) & (device_ns >= earlier) & lit
        refused = len(rows) - int(np.count_nonzero(valid))
        if refused:
            block = block.select(valid)
        if len(block.rows):
            self._take(block)
        return refused

    def put_active_calibration(self, document: bytes, table: bytes = b"") -> int:
        """Store a calibration (JSON) and its table (HDF5); return its row for the frames."""
        group = self._file["active_calibrations"]
        start, row = self._calibration_bytes, len(group["rows"])
        both = document + table
        group["bytes"].resize(start + len(both), axis=0)
        group["bytes"][start:] = np.frombuffer(both, np.uint8)
        group["rows"].resize(row + 1, axis=0)
        extent = np.array(
            (start, len(document), start + len(document), len(table), 0), CALIBRATION_EXTENT
        )
        extent["checksum"] = calibration_checksum(row, extent, document, table)
        group["rows"][row] = extent
        self._calibration_bytes += len(both)
        return row

    def flush(self, losses: Losses = NO_LOSSES) -> RecordingState:
        """Write what was appended to the file; return the state that is now safe.

        Args:
            losses: frames lost before the writer, stored with the state.
        """
        waiting = self._waiting
        self._write_columns()
        if self._lines is not None:
            self._lines.write_rest(waiting.frames)
        missing = self._last_sequence - self._first_sequence + 1 - waiting.frames
        state = replace(
            self._state,
            frames=waiting.frames,
            peaks=waiting.peaks,
            points=waiting.points,
            active_calibrations=len(self._file["active_calibrations/rows"]),
            duration_ns=self._last_device_ns - self._first_device_ns,
            missing=missing if waiting.frames else 0,
            **vars(losses),
        )
        self._file.flush()
        self._commit(state)
        return self._state

    def close(self, *, complete: bool = True, reason: str = "", losses: Losses = NO_LOSSES) -> None:
        """Flush, mark the file as complete or not, and close it; may be called twice."""
        if not self._file:
            return
        self.flush(losses)
        self._commit(replace(self._state, complete=complete, reason=reason))
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self.close(complete=kind is None)

    def _take(self, block: FrameBlock) -> None:
        rows = block.rows.copy()  # they may lie in a ring that goes on meanwhile
        if self._first_sequence < 0:
            self._first_sequence = int(rows["sequence"][0])
            self._first_device_ns = int(rows["exposure_device_ns"][0])
        self._last_sequence = int(rows["sequence"][-1])
        self._last_device_ns = int(rows["exposure_device_ns"][-1])
        base = self._waiting
        lines = block.lines if self._lines is not None else None
        peaks, points = block.peaks, block.points
        if not self._results:
            peaks, points = peaks[:0], points[:0]
            rows["peaks"] = rows["points"] = 0
        if len(peaks):
            peaks = peaks.copy()
            peaks["frame"] += base.frames
        if len(points):
            points = points.copy()
            points["frame"] += base.frames
        columns: dict[str, NDArray[Any]] = {
            name: rows[name]
            for name in COLUMNS
            if name in FRAME.fields  # type: ignore[operator]
        }
        columns["peaks_end"] = base.peaks + np.cumsum(rows["peaks"], dtype=np.int64)
        columns["points_end"] = base.points + np.cumsum(rows["points"], dtype=np.int64)
        columns["checksum"] = frame_checksums(rows, lines)
        columns["results_checksum"] = result_checksums(rows, peaks, points)
        if self._lines is not None and lines is not None:
            self._lines.put(base.frames, lines)
        self._waiting.add(columns, peaks, points)
        if self._waiting.rows >= _ROWS:
            self._write_columns()

    def _write_columns(self) -> None:
        columns, peaks, points = self._waiting.take()
        for name, values in columns.items():
            _extend(self._file["frames"][name], values)
        if len(peaks):
            _extend(self._file["peaks"], peaks)
        if len(points):
            _extend(self._file["points"], points)

    def _commit(self, state: RecordingState) -> None:
        """Write the state to the other of two rows: one of them is always valid."""
        self._number += 1
        self._file["state"][self._number % 2] = pack_state(state, self._number)
        self._file["state"].flush()
        self._state = state


def _extend(dataset: Any, values: NDArray[Any]) -> None:
    start = len(dataset)
    dataset.resize(start + len(values), axis=0)
    dataset[start:] = values
