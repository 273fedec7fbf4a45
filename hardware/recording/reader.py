"""RecordingReader: validates a recording and reads its frames and results."""

import hashlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from hardware.driver import DeviceDescription
from hardware.line_frame import FrameFlag, LineFrame
from hardware.recording.frame_block import FrameBlock, scan_shape
from hardware.recording.hdf5_file import RecordingFile, check_columns, read_column, read_description
from hardware.recording.layout import (
    CALIBRATION_EXTENT,
    CHUNK_FRAMES,
    COLUMNS,
    FORMAT,
    FRAME,
    NO_MARKER,
    PEAK,
    STATE,
    VERSION,
    RecordingInfo,
    RecordingState,
    calibration_checksum,
    frame_checksums,
    point_dtype,
    result_checksums,
    unpack_state,
)


class RecordingReader:
    """An open recording, validated except for its scans; a context manager.

    A file that is still being written is read up to the writer's last flush; ``refresh``
    advances to the newest one.

    Args:
        path: the file.
        columns: whether the frames' columns are validated as well.

    Raises:
        InvalidRecording: it cannot be read, is not a recording, has another version, is
            truncated or inconsistent; the message says which.
    """

    def __init__(self, path: Path, *, columns: bool = True) -> None:
        self._file = RecordingFile(path)
        try:
            self.info = self._check_header()
            if columns:
                check_columns(self._file, self.info)
        except BaseException:
            self._file.close()
            raise

    def refresh(self) -> RecordingInfo:
        """Return the current contents of the recording; new rows are not validated."""
        self.info = self._build_info(self.info.description, self.info.provenance)
        return self.info

    def fingerprint(self) -> bytes:
        """Return what tells a recording from others, and stays while frames are added.

        That is who wrote it and when, its device, and its first frame with its calibration.

        Raises:
            InvalidRecording: the file cannot be read.
        """
        digest = hashlib.sha256(repr((self.info.description, self.info.provenance)).encode())
        digest.update(repr((self.info.lines, self.info.results)).encode())
        if self.info.frames:
            for name in COLUMNS:
                digest.update(self._file.read(f"frames/{name}", slice(0, 1)).tobytes())
            row = int(self._file.read("frames/active_calibration", slice(0, 1))[0])
            if 0 <= row < self.info.state.active_calibrations:
                extent = self._file.read("active_calibrations/rows", slice(row, row + 1))
                digest.update(extent.tobytes())
        return digest.digest()

    def column(self, name: str) -> NDArray[Any]:
        """Return one of COLUMNS for all frames, shape (frames,).

        The checksums of the frames are not compared: ``block`` does that.
        """
        return read_column(self._file, self.info, name)

    def frames(self) -> Iterator[LineFrame]:
        """Yield the frames as they were recorded.

        Raises:
            InvalidRecording: the stored data are damaged, or there are no lines.
        """
        for first in self.chunk_starts():
            yield from self.chunk(first)

    def chunk_starts(self) -> range:
        """Return the first row of each chunk."""
        return range(0, self.info.frames, CHUNK_FRAMES)

    def chunk(self, first: int) -> list[LineFrame]:
        """Return up to CHUNK_FRAMES frames from row ``first`` on; see ``frames``."""
        if not self.info.lines:
            raise self._file.invalid("holds results only, and no lines that could be replayed")
        block = self.block(first, first + CHUNK_FRAMES, results=False)
        assert block.lines is not None
        block.lines.setflags(write=False)
        return [
            LineFrame(
                device=self.info.description.name,
                sequence=sequence,
                exposure_device_ns=device_ns,
                exposure_host_ns=host_ns,
                marker=None if marker == NO_MARKER else marker,
                lines=lines,
                flags=FrameFlag(flags),
            )
            for (sequence, device_ns, host_ns, marker, flags, *_), lines in zip(
                block.rows.tolist(), block.lines, strict=True
            )
        ]

    def block(self, first: int, end: int, *, results: bool = True) -> FrameBlock:
        """Return the frames of these rows, with their results where they were recorded.

        ``frame`` of a peak or a point counts within the block.

        Raises:
            InvalidRecording: the stored data are damaged.
        """
        rows = slice(first, max(first, min(end, self.info.frames)))
        columns = {name: self._file.read(f"frames/{name}", rows) for name in COLUMNS}
        lines = self._file.read("frames/lines", rows) if self.info.lines else None
        block_rows = np.zeros(rows.stop - rows.start, FRAME)
        for name in FRAME.names or ():
            if name in columns:
                block_rows[name] = columns[name]
        peaks = np.empty(0, PEAK)
        points = np.empty(0, point_dtype(len(self.info.description.sensors)))
        ends = {}
        for name in ("peaks", "points"):
            before = self._file.read(f"frames/{name}_end", slice(first - 1, first))
            ends[name] = np.concatenate((before if first else [0], columns[f"{name}_end"]))
            block_rows[name] = np.diff(ends[name])
        self._compare(frame_checksums(block_rows, lines), columns["checksum"], "lines", first)
        if results and self.info.results and len(block_rows):
            peaks, points = (
                self._file.read(name, slice(int(ends[name][0]), int(ends[name][-1])))
                for name in ("peaks", "points")
            )
            sums = result_checksums(block_rows, peaks, points)
            self._compare(sums, columns["results_checksum"], "results", first)
            peaks["frame"] -= first
            points["frame"] -= first
        return FrameBlock(block_rows, lines, peaks, points)

    def active_calibration(self, row: int) -> tuple[bytes, bytes]:
        """Return a calibration (JSON) and its table (HDF5), empty without one.

        Raises:
            InvalidRecording: there is none of this row, or it is damaged.
        """
        count = self.info.state.active_calibrations
        if not 0 <= row < count:
            raise self._file.invalid(f"has no row {row} of active_calibrations; it has {count}")
        extent = self._file.read("active_calibrations/rows", slice(row, row + 1))[0]
        document, table = (
            self._file.read("active_calibrations/bytes", slice(start, start + size)).tobytes()
            for start, size in (
                (int(extent["document_start"]), int(extent["document_bytes"])),
                (int(extent["table_start"]), int(extent["table_bytes"])),
            )
        )
        if calibration_checksum(row, extent, document, table) != extent["checksum"]:
            raise self._file.invalid(
                f"has damaged data in active_calibrations (the checksum of row {row} is another)"
            )
        return document, table

    def close(self) -> None:
        """Close the file; may be called twice."""
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _check_header(self) -> RecordingInfo:
        attributes = self._file.attributes()
        found, expected = (attributes.get("format"), attributes.get("version")), (FORMAT, VERSION)
        if found != expected:
            raise self._file.invalid(
                "is an HDF5 file of format {!r}, version {!r}; ".format(*found)
                + "this program reads {!r}, version {}".format(*expected)
            )
        texts = [str(attributes.get(name)) for name in ("description", "provenance")]
        try:
            description = read_description(texts[0])
            scan_shape(description)
        except InvalidParameter as error:
            unusable = error.detail if error.detail.startswith(("has ", "describes ")) else None
            raise self._file.invalid(
                unusable or f"describes an unusable device: {error.detail}"
            ) from error
        return self._build_info(description, self._provenance(texts[1]))

    def _provenance(self, text: str) -> dict[str, Any]:
        try:
            document = json.loads(text)
        except (ValueError, RecursionError) as error:
            raise self._file.invalid(f"has a provenance that is not JSON ({error})") from error
        if not isinstance(document, dict):
            raise self._file.invalid("has a provenance that is no JSON object")
        return document

    def _build_info(
        self, description: DeviceDescription, provenance: dict[str, Any]
    ) -> RecordingInfo:
        lines, results = "frames/lines" in self._file, "peaks" in self._file
        state = self._state()
        self._check_shapes(description, state, lines=lines, results=results)
        return RecordingInfo(
            description=description,
            frames=state.frames,
            duration_s=state.duration_ns * 1e-9,
            lost=state.missing,
            complete=state.complete,
            lines=lines,
            results=results,
            provenance=provenance,
            state=state,
        )

    def _state(self) -> RecordingState:
        """Return the newest valid state."""
        rows = self._file.rows("state", STATE)
        if rows != 2:
            raise self._file.invalid(f"holds {rows} rows in state; there must be 2")
        state = unpack_state(self._file.read("state", slice(None)))
        if state is None:
            raise self._file.invalid("has no whole state: it is damaged")
        return state[0]

    def _check_shapes(
        self,
        description: DeviceDescription,
        state: RecordingState,
        *,
        lines: bool,
        results: bool,
    ) -> None:
        """Check presence, type and length of all datasets."""
        expected: dict[str, tuple[np.dtype[Any], tuple[int, ...], int]] = {
            f"frames/{name}": (dtype, (), state.frames) for name, dtype in COLUMNS.items()
        }
        expected["active_calibrations/rows"] = (CALIBRATION_EXTENT, (), state.active_calibrations)
        expected["active_calibrations/bytes"] = (np.dtype(np.uint8), (), 0)
        if lines:
            expected["frames/lines"] = (np.dtype(np.uint16), scan_shape(description), state.frames)
        if results:
            expected["peaks"] = (PEAK, (), state.peaks)
            expected["points"] = (point_dtype(len(description.sensors)), (), state.points)
        for name, (dtype, row, count) in expected.items():
            length = self._file.rows(name, dtype, row)
            if not 0 <= count <= length:
                raise self._file.invalid(f"holds {length} rows in {name}; its state says {count}")

    def _compare(
        self, computed: NDArray[np.uint32], stored: NDArray[np.uint32], what: str, first: int
    ) -> None:
        wrong = computed != stored
        if wrong.any():
            raise self._file.invalid(
                f"has damaged data in frames/{what} (the checksum of row "
                f"{first + int(wrong.argmax())} is another)"
            )
