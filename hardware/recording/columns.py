"""The columns of a recording's frames, and what must hold of them."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from hardware.recording.hdf5_file import RecordingFile
from hardware.recording.info import RecordingInfo
from hardware.recording.layout import NO_CALIBRATION_ROW, NO_MARKER


def read_column(file: RecordingFile, info: RecordingInfo, name: str) -> NDArray[Any]:
    """Return one of COLUMNS for all frames, shape (frames,)."""
    return file.read(f"frames/{name}", slice(0, info.frames))


def check_columns(file: RecordingFile, info: RecordingInfo) -> None:
    """Look through what the frames say of themselves.

    Raises:
        InvalidRecording: a column contradicts itself or the others; the message has the first
            row that does.
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
    if info.version == 1:
        return
    state = info.state
    for name, rows in (("peaks_end", state.peaks), ("points_end", state.points)):
        ends = read_column(file, info, name)
        wrong = (np.diff(ends, prepend=0) < 0) | (ends > rows)
        refuse_where(wrong, name, f"not decrease, nor be more than the {rows} rows")
    in_force = read_column(file, info, "in_force")
    refuse_where(
        (in_force < NO_CALIBRATION_ROW) | (in_force >= state.in_force),
        "in_force",
        f"be below the number of calibrations, {state.in_force}",
    )
