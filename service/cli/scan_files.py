"""Reads line scans from a file: CSV with one scan a row, a NumPy array, or a recording."""

import csv
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from compute.damaged_file import refusing_damage
from compute.errors import InvalidParameter
from compute.signal.centroid_settings import MAX_PIXELS, MIN_PIXELS
from service.api.line_scans.schema import FULL_SCALE, PixelNoise

if TYPE_CHECKING:
    from hardware.driver import DeviceDescription

Scans = NDArray[np.uint16]

_NUMPY = b"\x93NUMPY"
_HDF5 = b"\x89HDF\r\n\x1a\n"


@dataclass(frozen=True, eq=False)
class ScanFile:
    """Scans of a file.

    Args:
        scans: counts, shape (L, P).
        first: number of the first of them in the file, or of its sensor in a recording.
        names: what to call each of them.
        noise: of the sensors that they come from; None where the file does not say.
        sensors: which sensor each of them is of, in a recording.
        device: that they were recorded from.
    """

    scans: Scans
    first: int
    names: tuple[str, ...]
    noise: PixelNoise | None
    sensors: tuple[str, ...] | None = None
    device: "DeviceDescription | None" = None


def read_scans(
    path: Path, *, scan: int | None = None, exposure: int | None = None, sensor: str | None = None
) -> ScanFile:
    """Read the scans of a file, which is recognised by its content.

    Args:
        path: the file.
        scan: only this one, counted from 0; of a recording's exposure, the sensor of this number.
        exposure: of a recording, counted from 0; None: the first.
        sensor: only the line of this sensor of a recording.

    Raises:
        InvalidParameter: the file cannot be read as lines of counts, or has no such line.
        InvalidRecording: it is a recording that cannot be used.
    """
    try:
        with path.open("rb") as file:
            start = file.read(8)
    except OSError as error:
        raise InvalidParameter(f"{path} cannot be read: {error.strerror}") from error
    if start == _HDF5:
        scan_file = _recorded(path, exposure or 0, sensor)
    else:
        if exposure is not None or sensor is not None:
            name = "--exposure" if sensor is None else "--sensor"
            raise InvalidParameter(f"{path} is no recording; {name} is for recordings")
        lines = _numpy(path) if start.startswith(_NUMPY) else _csv(path)
        scan_file = ScanFile(lines, 0, tuple(f"line {row}" for row in range(len(lines))), None)
    pixels = scan_file.scans.shape[1]
    if not MIN_PIXELS <= pixels <= MAX_PIXELS:
        raise InvalidParameter(
            f"{path} has lines of {pixels} pixels; they must have {MIN_PIXELS} to {MAX_PIXELS}"
        )
    if scan is None:
        return scan_file
    if scan >= len(scan_file.scans):
        raise InvalidParameter(
            f"{path} has no line {scan}; its lines have the numbers 0 to {len(scan_file.scans) - 1}"
        )
    one = slice(scan, scan + 1)
    sensors = None if scan_file.sensors is None else scan_file.sensors[one]
    return replace(
        scan_file,
        scans=scan_file.scans[one],
        first=scan_file.first + scan,
        names=scan_file.names[one],
        sensors=sensors,
    )


def _recorded(path: Path, exposure: int, sensor: str | None) -> ScanFile:
    # The file library is loaded by who reads a recording.
    from hardware.recording.reader import RecordingReader

    with RecordingReader(path) as recording:
        device, frames = recording.info.description, recording.info.frames
        if exposure >= frames:
            raise InvalidParameter(
                f"{path} has no exposure {exposure}; its exposures are 0 to {frames - 1}"
                if frames
                else f"{path} has no exposures"
            )
        read = recording.chunk(exposure)[0]
    names = [one.name for one in device.sensors]
    first, last = 0, len(names)
    if sensor is not None:
        if sensor not in names:
            raise InvalidParameter(
                f'{path} has no sensor "{sensor}"; its sensors are {", ".join(names)}'
            )
        first = names.index(sensor)
        last = first + 1
    noise = PixelNoise.model_construct(
        electrons_per_count=device.electrons_per_count,
        read_noise_electrons=device.read_noise_electrons,
        offset_counts=device.offset_counts,
        full_scale_counts=2**device.bits - 1,
    )
    chosen = tuple(f"{name}, exposure {exposure}" for name in names[first:last])
    return ScanFile(read.lines[first:last], first, chosen, noise, tuple(names[first:last]), device)


def _numpy(path: Path) -> Scans:
    def invalid(reason: str) -> InvalidParameter:
        return InvalidParameter(f"{path} cannot be read as a NumPy array: {reason}")

    try:
        with refusing_damage(invalid):
            # Mapped, as a damaged header may declare more than the memory holds.
            values = np.load(path, mmap_mode="r", allow_pickle=False)
    except MemoryError as error:  # of Python's parser
        raise invalid("its header is nested too deeply") from error
    if values.ndim == 1:
        values = values[None]
    if values.ndim != 2 or values.dtype.kind not in "uif" or not len(values):
        raise InvalidParameter(
            f"{path} holds {values.dtype} of shape {values.shape}; it must be counts of shape "
            "(L, P) or (P,)"
        )
    return _counts(path, values, lambda *at: str(values[at]))


def _csv(path: Path) -> Scans:
    """Read rows of numbers; a first row with a cell that is no number is a header."""
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            text = file.read()
        first = text.partition("\n")[0]
        delimiter = next((mark for mark in ",;\t" if mark in first), ",")
        rows = [row for row in csv.reader(text.splitlines(), delimiter=delimiter) if any(row)]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InvalidParameter(f"{path} cannot be read as CSV: {error}") from error
    if rows and None in map(_number, rows[0]):
        rows = rows[1:]
    if not rows:
        raise InvalidParameter(f"{path} has no line of counts; it needs one in each row")
    for number, row in enumerate(rows):
        if len(row) != len(rows[0]):
            raise InvalidParameter(
                f"{path}, line {number} has {len(row)} values and line 0 has {len(rows[0])}; all "
                "must be of one length"
            )
    values = np.array([list(map(_number, row)) for row in rows], np.float64)
    return _counts(path, values, lambda row, column: f'"{rows[row][column][:40]}"')


def _number(cell: str) -> float | None:
    try:
        return float(cell)
    except ValueError:
        return None


def _counts(path: Path, values: NDArray[Any], text: Callable[[int, int], str]) -> Scans:
    """Return values (L, P) as counts; ``text`` is what the file has in a row and column."""
    # The negation also finds NaN.
    wrong = ~((values >= 0) & (values <= FULL_SCALE) & (values == np.floor(values)))
    if wrong.any():
        row, column = (int(index) for index in np.argwhere(wrong)[0])
        raise InvalidParameter(
            f"{path}, line {row}, pixel {column} is {text(row, column)}; it must be a whole "
            f"number in 0 .. {FULL_SCALE}"
        )
    return np.array(values, dtype=np.uint16)
