"""The reader of recordings: checks a file from end to end, then gives its frames back."""

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

import h5py
import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter, ValidationError

from compute.errors import InvalidParameter, InvalidRecording
from hardware.driver import DeviceDescription, PeakMethod
from hardware.frame import FrameFlag, LineFrame
from hardware.recording import CHUNK_FRAMES, COLUMNS, FORMAT, NO_MARKER, VERSION, line_shape


@dataclass(frozen=True)
class _Recorded(DeviceDescription):
    """A description as it was written; before lines were fitted it named no method."""

    peaks: PeakMethod = "centroid"


_DESCRIPTION = TypeAdapter(_Recorded)

_MOST_HZ: Final = 1e6
_MOST_UM: Final = 1000.0
_FULL: Final = 2**16 - 1


@dataclass(frozen=True)
class RecordingInfo:
    """What a recording holds.

    Args:
        description: the device that it is of.
        frames: number of frames.
        duration_s: from the first exposure to the last, on the device's clock [s].
        lost: exposures missing between the first frame and the last.
        complete: whether the writer closed it; False after a crash: the end may be missing.
    """

    description: DeviceDescription
    frames: int
    duration_s: float
    lost: int
    complete: bool


class RecordingReader:
    """An open recording, checked from end to end but for the lines; a context manager.

    Args:
        path: the file.

    Raises:
        InvalidRecording: it cannot be read, is not a recording, of another version, cut short,
            or contradicts itself; the message says which.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        if not path.is_file():
            raise InvalidRecording(f"{path.name} is not a file; give a recording")
        try:
            self._file = h5py.File(path, "r")
        except OSError as error:
            raise self._invalid(f"is not an HDF5 file, or is cut short ({error})") from error
        try:
            self.info = self._checked()
        except BaseException:
            self._file.close()
            raise

    def column(self, name: str) -> NDArray[Any]:
        """Return one of COLUMNS for all frames, shape (frames,), as it was recorded."""
        return self._read(name, slice(None))

    def frames(self) -> Iterator[LineFrame]:
        """Yield the frames as they were recorded.

        Raises:
            InvalidRecording: the stored data are damaged.
        """
        for first in self.chunk_starts():
            yield from self.chunk(first)

    def chunk_starts(self) -> range:
        """Return the rows to read chunks from, one after the other."""
        return range(0, self.info.frames, CHUNK_FRAMES)

    def chunk(self, first: int) -> list[LineFrame]:
        """Return up to CHUNK_FRAMES frames from row ``first`` on; see ``frames``."""
        rows = slice(first, min(first + CHUNK_FRAMES, self.info.frames))
        lines = self._read("lines", rows)
        lines.setflags(write=False)
        columns = {name: self._read(name, rows).tolist() for name in COLUMNS}
        return [
            LineFrame(
                device=self.info.description.name,
                sequence=columns["sequence"][row],
                exposure_device_ns=columns["exposure_device_ns"][row],
                exposure_host_ns=columns["exposure_host_ns"][row],
                marker=None if columns["marker"][row] == NO_MARKER else columns["marker"][row],
                lines=lines[row],
                flags=FrameFlag(columns["flags"][row]),
            )
            for row in range(len(lines))
        ]

    def close(self) -> None:
        """Close the file; may be called twice."""
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def _checked(self) -> RecordingInfo:
        attributes = self._attributes()
        if attributes.get("format") != FORMAT:
            raise self._invalid(
                f"is an HDF5 file of format {attributes.get('format')!r}, not {FORMAT!r}"
            )
        if attributes.get("version") != VERSION:
            raise self._invalid(
                f"has version {attributes.get('version')}; this program reads version {VERSION}"
            )
        try:
            recorded = _DESCRIPTION.validate_json(str(attributes.get("description", "")))
            description = DeviceDescription(**vars(recorded))
            shape = line_shape(description)
        except ValidationError as error:
            first = error.errors()[0]
            where = ".".join(str(part) for part in first["loc"]) or "the whole"
            raise self._invalid(
                f"has an unusable description of the device: {where}: {first['msg']}"
            ) from error
        except InvalidParameter as error:
            raise self._invalid(f"describes an unusable device: {error.detail}") from error
        self._check_values(description)
        frames = self._checked_shapes(shape)
        sequence = self.column("sequence")
        device_ns = self.column("exposure_device_ns")
        marker = self.column("marker")
        self._refuse_where(
            np.diff(sequence, prepend=-1) <= 0, "sequence", "increase from 0 or more"
        )
        self._refuse_where(np.diff(device_ns) < 0, "exposure_device_ns", "not decrease", 1)
        self._refuse_where(
            (marker < NO_MARKER) | (marker >= max(description.markers, 0)),
            "marker",
            f"be below the number of strobed markers, {description.markers}",
        )
        return RecordingInfo(
            description=description,
            frames=frames,
            duration_s=float(device_ns[-1] - device_ns[0]) * 1e-9 if frames else 0.0,
            lost=int(sequence[-1] - sequence[0]) + 1 - frames if frames else 0,
            complete=attributes.get("complete") is True,
        )

    def _check_values(self, description: DeviceDescription) -> None:
        """Check that the description's values mean something; NaN and infinities fit nowhere."""
        rate, gain = description.frame_rate_hz, description.electrons_per_count
        noise, offset = description.read_noise_electrons, description.offset_counts
        names = Counter(sensor.name for sensor in description.sensors)
        checks = [
            ("frame_rate_hz", rate, 0 <= rate <= _MOST_HZ, f"0 (not known) to {_MOST_HZ:g}"),
            ("bits", description.bits, 1 <= description.bits <= 16, "1 to 16"),
            ("electrons_per_count", gain, 0 < gain < math.inf, "positive"),
            ("read_noise_electrons", noise, 0 <= noise < math.inf, "0 or more"),
            ("offset_counts", offset, abs(offset) <= _FULL, f"within -{_FULL} to {_FULL}"),
            ("markers", description.markers, description.markers >= 0, "0 or more"),
            *(
                ("a sensor's name", name, 1 <= len(name) <= 64 and "\0" not in name,
                 "1 to 64 characters without NUL")
                for name in names
            ),
            *(
                ("a sensor's name", name, count == 1, "a name of its own")
                for name, count in names.items()
            ),
            *(
                ("pitch_um", sensor.pitch_um, 0 < sensor.pitch_um <= _MOST_UM,
                 f"positive, at most {_MOST_UM:g}")
                for sensor in description.sensors
            ),
        ]  # fmt: skip
        for name, value, good, right in checks:
            if not good:
                raise self._invalid(
                    f"describes an unusable device: {name} is {value!r:.80}; it must be {right}"
                )

    def _attributes(self) -> dict[str, object]:
        """Return the root's attributes as plain Python values."""
        try:
            return {
                name: value.tolist() if isinstance(value, np.ndarray | np.generic) else value
                for name, value in self._file.attrs.items()
            }
        except (OSError, RuntimeError, KeyError, TypeError, ValueError) as error:
            raise self._invalid(f"has damaged attributes ({error})") from error

    def _checked_shapes(self, line: tuple[int, int]) -> int:
        """Check that all datasets are there, of their type and of one length; return it."""
        lengths = {}
        expected = {name: (dtype, ()) for name, dtype in COLUMNS.items()}
        for name, (dtype, row) in {**expected, "lines": (np.dtype(np.uint16), line)}.items():
            dataset = self._file.get(f"frames/{name}")
            if not isinstance(dataset, h5py.Dataset):
                raise self._invalid(f"lacks the dataset frames/{name}")
            if dataset.dtype != dtype or len(dataset.shape) == 0 or dataset.shape[1:] != row:
                raise self._invalid(
                    f"holds frames/{name} as {dataset.dtype} of shape {dataset.shape}; "
                    f"it must be {dtype} of shape {('frames', *row)}"
                )
            lengths[name] = dataset.shape[0]
        if len(set(lengths.values())) != 1:
            listed = ", ".join(f"{name} {length}" for name, length in lengths.items())
            raise self._invalid(f"has datasets of different lengths: {listed}")
        return int(lengths["lines"])

    def _refuse_where(
        self, wrong: NDArray[np.bool_], name: str, right: str, offset: int = 0
    ) -> None:
        if wrong.any():
            row = int(wrong.argmax()) + offset
            raise self._invalid(
                f"has {name} {self.column(name)[row]} in row {row}; it must {right}"
            )

    def _read(self, name: str, rows: slice) -> NDArray[Any]:
        try:
            values: NDArray[Any] = self._file[f"frames/{name}"][rows]
        except (OSError, RuntimeError) as error:
            raise self._invalid(f"has damaged data in frames/{name} ({error})") from error
        return values

    def _invalid(self, reason: str) -> InvalidRecording:
        return InvalidRecording(f"{self._path.name} {reason}", file=self._path.name)


def read_recording(path: Path) -> RecordingInfo:
    """Return what a recording holds.

    Raises:
        InvalidRecording: see ``RecordingReader``.
    """
    with RecordingReader(path) as recording:
        return recording.info
