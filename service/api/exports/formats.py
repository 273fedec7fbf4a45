"""Export formats: file suffixes and their writers; TRC, the simplest of them."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

from compute.errors import InvalidParameter
from service.api.exports.c3d_file import write_c3d
from service.api.exports.motion_table import MotionTable
from service.api.exports.sequence_file import write_sequence
from service.api.exports.tabular_files import write_csv, write_parquet
from service.api.exports.trajectories import Trajectory, trajectories


def write_trc(table: MotionTable, found: Sequence[Trajectory], path: Path) -> None:
    """Write trajectories as TRC (track row column): tab-separated text, blank cells are gaps.

    As OpenSim describes it: two rows of facts' names and values behind the file's own line, two
    rows of labels, an empty one, then one row for each frame. Frames are numbered from 1, those
    that were lost are left out. Times are on the device's clock since the first exposure [s].
    """
    numbers = (table.sequence - table.sequence[:1] + 1).tolist()
    facts = {
        "DataRate": f"{table.rate_hz:.6g}",
        "CameraRate": f"{table.rate_hz:.6g}",
        "NumFrames": len(table),
        "NumMarkers": len(found),
        "Units": "mm",
        "OrigDataRate": f"{table.rate_hz:.6g}",
        "OrigDataStartFrame": 1,
        "OrigNumFrames": numbers[-1] if numbers else 0,
    }
    head = [
        ["PathFileType", "4", "(X/Y/Z)", path.name],
        list(facts),
        [str(value) for value in facts.values()],
        ["Frame#", "Time", *(cell for one in found for cell in (one.label, "", ""))],
        ["", "", *(f"{axis}{place}" for place in range(1, len(found) + 1) for axis in "XYZ")],
        [],
    ]
    places = [one.position_mm for one in found]
    with path.open("w", encoding="utf-8", newline="") as file:
        for row in head:
            file.write("\t".join(row) + "\n")
        for index, (number, time_s) in enumerate(zip(numbers, table.time_s.tolist(), strict=True)):
            cells = [_cell(value) for place in places for value in place[index].tolist()]
            file.write("\t".join([str(number), f"{time_s:.9f}", *cells]) + "\n")


def _cell(value: float) -> str:
    return f"{value:.6f}" if value == value else ""


_TABLES: Final[dict[str, Callable[[MotionTable, Path], None]]] = {
    ".csv": write_csv,
    ".parquet": write_parquet,
    ".igs.mha": write_sequence,
}
_TRAJECTORIES: Final[dict[str, Callable[[MotionTable, list[Trajectory], Path], None]]] = {
    ".c3d": write_c3d,
    ".trc": write_trc,
}
SUFFIXES: Final = (*_TRAJECTORIES, *_TABLES)
TRAJECTORY_SUFFIXES: Final = tuple(_TRAJECTORIES)


def suffix_of(path: Path) -> str:
    """Return which of SUFFIXES a file's name has; raises InvalidParameter."""
    name = path.name.lower()
    for suffix in SUFFIXES:
        if name.endswith(suffix) and len(name) > len(suffix):
            return suffix
    raise InvalidParameter(
        f"{path.name} does not say in which format; the name must end in "
        f"{', '.join(SUFFIXES[:-1])} or {SUFFIXES[-1]}"
    )


def write_export(
    table: MotionTable, path: Path, *, predicted: bool = False, points: bool = False
) -> None:
    """Write a table to a file, in the format of the file's suffix.

    Args:
        table: what was found.
        path: the file; it must not exist.
        predicted: as of ``trajectories``.
        points: likewise.

    Raises:
        InvalidParameter: the suffix is none, the file exists, or there is nothing to write.
        MissingLibrary: the format needs a library that is not installed.
    """
    suffix = suffix_of(path)
    if path.exists():
        raise InvalidParameter(f"{path} exists; choose another name")
    if suffix in _TABLES:
        _TABLES[suffix](table, path)
    else:
        _TRAJECTORIES[suffix](table, trajectories(table, predicted=predicted, points=points), path)
