"""The writer of recordings: line frames in an HDF5 file, bit by bit.

Layout, version 1: the root's attributes ``format``, ``version``, ``complete`` (whether the
writer closed the file) and ``description`` (the device's description as JSON); the group
``frames`` with one row for each frame in the datasets of ``COLUMNS`` and in ``lines``, uint16,
shape (frames, sensors, pixels). A marker of -1 stands for none.
"""

import json
from dataclasses import asdict
from pathlib import Path
from types import TracebackType
from typing import Final, Literal, Self

import h5py
import numpy as np

from compute.errors import InvalidParameter
from hardware.driver import DeviceDescription
from hardware.frame import LineFrame

FORMAT: Final = "lumiline-recording"
VERSION: Final = 1
COLUMNS: Final = {
    "sequence": np.dtype(np.int64),
    "exposure_device_ns": np.dtype(np.int64),
    "exposure_host_ns": np.dtype(np.int64),
    "marker": np.dtype(np.int32),
    "flags": np.dtype(np.uint32),
}
CHUNK_FRAMES: Final = 32
NO_MARKER: Final = -1


def line_shape(description: DeviceDescription) -> tuple[int, int]:
    """Return the number of sensors and of pixels of each.

    Raises:
        InvalidParameter: there is no sensor, or they are of different lengths.
    """
    pixels = {sensor.pixels for sensor in description.sensors}
    if len(pixels) != 1 or min(pixels) < 1:
        raise InvalidParameter(
            f"the sensors have {sorted(pixels)} pixels; a recording needs at least one sensor, "
            "all of them of one length",
            pixels=sorted(pixels),
        )
    return len(description.sensors), pixels.pop()


class RecordingWriter:
    """Writes frames of one device to a new file; a context manager.

    Frames are gathered and written in chunks with a checksum; what was appended since the last
    ``flush`` is lost when the process dies.

    Args:
        path: the file; an existing one is replaced.
        description: the device.
        compression: "gzip" takes about a third of the space and three times the work.

    Raises:
        InvalidParameter: there is no sensor, or they are of different lengths.
    """

    def __init__(
        self,
        path: Path,
        description: DeviceDescription,
        compression: Literal["gzip"] | None = None,
    ) -> None:
        self._shape = line_shape(description)
        self._description = description
        self._pending: list[LineFrame] = []
        self._last_sequence = -1
        self._last_device_ns = int(np.iinfo(np.int64).min)
        self._file = h5py.File(path, "w")
        self._file.attrs["format"] = FORMAT
        self._file.attrs["version"] = VERSION
        self._file.attrs["complete"] = False
        self._file.attrs["description"] = json.dumps(asdict(description))
        group = self._file.create_group("frames")
        for name, dtype in COLUMNS.items():
            group.create_dataset(
                name, shape=(0,), maxshape=(None,), dtype=dtype, chunks=(4096,), fletcher32=True
            )
        group.create_dataset(
            "lines",
            shape=(0, *self._shape),
            maxshape=(None, *self._shape),
            dtype=np.uint16,
            chunks=(CHUNK_FRAMES, 1, self._shape[1]),
            compression=compression,
            compression_opts=1 if compression else None,
            shuffle=compression is not None,
            fletcher32=True,
        )

    def append(self, frame: LineFrame) -> None:
        """Add a frame.

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
        self._last_sequence = frame.sequence
        self._last_device_ns = frame.exposure_device_ns
        self._pending.append(frame)
        if len(self._pending) == CHUNK_FRAMES:
            self._write()

    def flush(self) -> None:
        """Bring everything that was appended to the file system."""
        self._write()
        self._file.flush()

    def close(self, *, complete: bool = True) -> None:
        """Write what is left and mark the file as complete or not; may be called twice."""
        if self._file:
            self._write()
            self._file.attrs["complete"] = complete
            self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close(complete=kind is None)

    def _write(self) -> None:
        frames, self._pending = self._pending, []
        if not frames:
            return
        group = self._file["frames"]
        start = len(group["lines"])
        rows = {
            "sequence": [frame.sequence for frame in frames],
            "exposure_device_ns": [frame.exposure_device_ns for frame in frames],
            "exposure_host_ns": [frame.exposure_host_ns for frame in frames],
            "marker": [NO_MARKER if frame.marker is None else frame.marker for frame in frames],
            "flags": [int(frame.flags) for frame in frames],
            "lines": np.stack([frame.lines for frame in frames]),
        }
        for name, values in rows.items():
            group[name].resize(start + len(frames), axis=0)
            group[name][start:] = values
