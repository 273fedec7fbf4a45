"""Export formats: file suffixes and their writers."""

from collections.abc import Callable
from pathlib import Path
from typing import Final

from compute.errors import InvalidParameter
from service.api.exports.c3d_file import write_c3d
from service.api.exports.motion_table import MotionTable
from service.api.exports.sequence_file import write_sequence
from service.api.exports.tabular_files import write_csv, write_parquet
from service.api.exports.trajectories import Trajectory, trajectories
from service.api.exports.trc_file import write_trc

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
