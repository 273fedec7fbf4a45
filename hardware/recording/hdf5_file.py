"""Validated access to the HDF5 file of a recording, and to the description stored in it."""

import ctypes
import math
import os
from collections import Counter
from collections.abc import Callable
from contextlib import AbstractContextManager
from functools import cache
from pathlib import Path
from typing import Any, Final

import h5py
import numpy as np
from h5py._objects import phil
from numpy.typing import NDArray
from pydantic import TypeAdapter, ValidationError

from compute.damaged_file import refusing_damage
from compute.errors import InvalidParameter, InvalidRecording
from hardware.driver import DeviceDescription
from hardware.recording.layout import NO_CALIBRATION_ROW, NO_MARKER, RecordingInfo

_READ_ATTEMPTS: Final = 26
"""How often metadata with a wrong checksum are read in a file that is being written.

HDF5 waits 1 ns, then twice as long each time, 67 ms in all. Its own 100 attempts would not end.
"""
_SWMR: Final = 4
_FLAGS_AT: Final = 11
"""Offset of the consistency flags in a superblock of version 3; _SWMR: open for writing."""


class RecordingFile:
    """An open recording; also one still being written, or left open by a crashed writer.

    Raises:
        InvalidRecording: it does not exist, is not HDF5, or is truncated.
    """

    def __init__(self, path: Path) -> None:
        self._name = path.name
        if not path.is_file():
            raise self.invalid("is not a file; give a recording")
        with refusing_damage(
            lambda reason: self.invalid(f"is not an HDF5 file, or is cut short ({reason})")
        ):
            self._written = _being_written(path)
            self._file = _open_written(path) if self._written else h5py.File(path, "r")

    def __contains__(self, name: str) -> bool:
        """Return whether the file has a member of this name."""
        with self._refusing_damage("members"):
            return name in self._file

    def close(self) -> None:
        """Close it; may be called twice."""
        self._file.close()

    def attributes(self) -> dict[str, object]:
        """Return the root's attributes of fixed size as plain Python values, texts decoded."""
        with self._refusing_damage("attributes"):
            attributes = self._file.attrs
            found = {
                name: attributes[name].tolist()
                for name in attributes
                # Reading a damaged text of variable length would not end.
                if not attributes.get_id(name).dtype.hasobject
            }
            return {
                name: value.decode() if isinstance(value, bytes) else value
                for name, value in found.items()
            }

    def rows(self, name: str, dtype: np.dtype[Any], row: tuple[int, ...] = ()) -> int:
        """Check a dataset's type and shape; return its current number of rows.

        Args:
            name: of the dataset.
            dtype: the type that it must have.
            row: the shape that a row must have.
        """
        with self._refusing_damage(f"data in {name}"):
            dataset = self._file.get(name)
            if not isinstance(dataset, h5py.Dataset):
                raise self.invalid(f"lacks the dataset {name}")
            if self._written:
                dataset.refresh()
            if dataset.dtype != dtype or len(dataset.shape) == 0 or dataset.shape[1:] != row:
                raise self.invalid(
                    f"holds {name} as {dataset.dtype} of shape {dataset.shape}; "
                    f"it must be {dtype} of shape {('frames', *row)}"
                )
            return int(dataset.shape[0])

    def read(self, name: str, rows: slice) -> NDArray[Any]:
        """Return rows of a dataset."""
        with self._refusing_damage(f"data in {name}"):
            values: NDArray[Any] = self._file[name][rows]
        return values

    def _refusing_damage(self, what: str) -> AbstractContextManager[None]:
        return refusing_damage(lambda reason: self.invalid(f"has damaged {what} ({reason})"))

    def invalid(self, reason: str) -> InvalidRecording:
        """Return an InvalidRecording for this file."""
        return InvalidRecording(f"{self._name} {reason}", file=self._name)


def _open_written(path: Path) -> h5py.File:
    """Open a file that a program writes, or left open; raises as h5py does."""
    access = h5py.h5p.create(h5py.h5p.FILE_ACCESS)
    access.set_libver_bounds(h5py.h5f.LIBVER_LATEST, h5py.h5f.LIBVER_LATEST)
    with phil:
        set_attempts = _read_attempts_setter()
        if set_attempts is not None:
            set_attempts(access.id, _READ_ATTEMPTS)
    flags = h5py.h5f.ACC_RDONLY | h5py.h5f.ACC_SWMR_READ
    return h5py.File(h5py.h5f.open(os.fsencode(path), flags, fapl=access))


@cache
def _read_attempts_setter() -> Callable[[int, int], int] | None:
    """Return HDF5's H5Pset_metadata_read_attempts, which h5py does not wrap; None: not found."""
    try:
        function = ctypes.PyDLL(h5py.h5p.__file__).H5Pset_metadata_read_attempts
    except (OSError, AttributeError):  # on Windows a library's symbols are its own only
        return None
    function.argtypes, function.restype = [ctypes.c_int64, ctypes.c_uint], ctypes.c_int
    return function


def _being_written(path: Path) -> bool:
    """Return whether the file is marked as open for writing; raises OSError."""
    with path.open("rb") as file:
        start = file.read(_FLAGS_AT + 1)
    return len(start) > _FLAGS_AT and start[8] == 3 and bool(start[_FLAGS_AT] & _SWMR)


def read_column(file: RecordingFile, info: RecordingInfo, name: str) -> NDArray[Any]:
    """Return one of COLUMNS for all frames, shape (frames,)."""
    return file.read(f"frames/{name}", slice(0, info.frames))


def check_columns(file: RecordingFile, info: RecordingInfo) -> None:
    """Check the columns of the frames for consistency.

    Raises:
        InvalidRecording: a column contradicts itself or the others; the message names the first
            such row.
    """

    def refuse_where(wrong: NDArray[np.bool_], name: str, right: str, offset: int = 0) -> None:
        if wrong.any():
            row = int(wrong.argmax()) + offset
            value = read_column(file, info, name)[row]
            raise file.invalid(f"has {name} {value} in row {row}; it must {right}")

    sequence, device_ns, marker = (
        read_column(file, info, name) for name in ("sequence", "exposure_device_ns", "marker")
    )
    markers = info.description.markers
    refuse_where(np.diff(sequence, prepend=-1) <= 0, "sequence", "increase from 0 or more")
    refuse_where(np.diff(device_ns) < 0, "exposure_device_ns", "not decrease", 1)
    refuse_where(
        (marker < NO_MARKER) | (marker >= max(markers, 0)),
        "marker",
        f"be below the number of strobed markers, {markers}",
    )
    state = info.state
    for name, rows in (("peaks_end", state.peaks), ("points_end", state.points)):
        ends = read_column(file, info, name)
        wrong = (np.diff(ends, prepend=0) < 0) | (ends > rows)
        refuse_where(wrong, name, f"not decrease, nor be more than the {rows} rows")
    calibration = read_column(file, info, "active_calibration")
    refuse_where(
        (calibration < NO_CALIBRATION_ROW) | (calibration >= state.active_calibrations),
        "active_calibration",
        f"be below the number of calibrations, {state.active_calibrations}",
    )


_DESCRIPTION = TypeAdapter(DeviceDescription)

_MAX_HZ: Final = 1e6
_MAX_UM: Final = 1000.0
_FULL: Final = 2**16 - 1


def read_description(text: str) -> DeviceDescription:
    """Return the device description in a recording's JSON.

    Raises:
        InvalidParameter: it is not a description, or an unusable one; the message continues a
            sentence that begins with the file's name.
    """
    try:
        description = _DESCRIPTION.validate_json(text)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"]) or "the whole"
        raise InvalidParameter(
            f"has an unusable description of the device: {where}: {first['msg']}"
        ) from error
    _check_values(description)
    return description


def _check_values(description: DeviceDescription) -> None:
    """Check the ranges of the description's values; NaN and infinities are invalid."""
    rate, gain = description.frame_rate_hz, description.electrons_per_count
    noise, offset = description.read_noise_electrons, description.offset_counts
    names = Counter(sensor.name for sensor in description.sensors)
    checks = [
        ("frame_rate_hz", rate, 0 <= rate <= _MAX_HZ, f"0 (not known) to {_MAX_HZ:g}"),
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
            ("pitch_um", sensor.pitch_um, 0 < sensor.pitch_um <= _MAX_UM,
             f"positive, at most {_MAX_UM:g}")
            for sensor in description.sensors
        ),
    ]  # fmt: skip
    for name, value, good, right in checks:
        if not good:
            raise InvalidParameter(
                f"describes an unusable device: {name} is {value!r:.80}; it must be {right}"
            )
