"""Reads a CSV file of readings, one column a sensor: control points or a moved wand."""

import csv
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from compute.camera.model import SensorModel
from compute.errors import InvalidParameter

Array = NDArray[np.float64]

POSITION = ("X_mm", "Y_mm", "Z_mm")
PLACE = ("pose", "marker")
READING, DEVIATION = "_px", "_sigma_px"


@dataclass(frozen=True, eq=False)
class ReadingTable:
    """Readings of sensors, here of a wand.

    Args:
        path: the file.
        sensors: names of the S sensors, in the order of their columns.
        readings_px: by pose and marker, shape (B, K, S), NaN where not seen or not in the file.
        sigma_px: likewise, or None when the file has no standard deviations.
    """

    path: Path
    sensors: tuple[str, ...]
    readings_px: Array
    sigma_px: Array | None

    def in_order_of(self, models: Sequence[SensorModel], source: str = "the calibration") -> Self:
        """Return the readings in the order of a calibration's sensors; raises InvalidParameter."""
        names = tuple(model.name for model in models)
        if set(self.sensors) != set(names):
            raise InvalidParameter(
                f"{self.path} has readings of {', '.join(self.sensors)}; {source} is of "
                f"{', '.join(names)}"
            )
        order = [self.sensors.index(name) for name in names]
        sigma = None if self.sigma_px is None else self.sigma_px[..., order]
        return replace(
            self, sensors=names, readings_px=self.readings_px[..., order], sigma_px=sigma
        )


@dataclass(frozen=True, eq=False)
class ObservationTable(ReadingTable):
    """Readings of N points, shape (N, S); NaN where the cell is empty.

    Args:
        points_mm: shape (N, 3).
    """

    points_mm: Array


def read_observations(path: Path) -> ObservationTable:
    """Read columns ``X_mm, Y_mm, Z_mm``, and for each sensor ``NAME_px`` [, ``NAME_sigma_px``].

    Other columns are left alone; an empty reading means that the sensor did not see the point.

    Raises:
        InvalidParameter: a column is missing, or a cell is not a number.
    """
    file = _File(path, POSITION)
    points = file.numbers(list(POSITION), optional=False)
    return ObservationTable(path, file.sensors, *file.readings(), points)


def read_wand(path: Path, markers: int) -> ReadingTable:
    """Read columns ``pose, marker`` (from 1), and for each sensor ``NAME_px`` [, sigma].

    Poses are told apart by their text and kept in the order in which they first come.

    Raises:
        InvalidParameter: a column is missing, a cell is not a number, a marker that the wand has
            not got, or a pose's marker given twice.
    """
    file = _File(path, PLACE)
    readings, sigma = file.readings()
    poses: dict[str, int] = {}
    places: dict[tuple[int, int], int] = {}
    for line, row in enumerate(file.rows, start=2):
        pose = poses.setdefault((row["pose"] or "").strip(), len(poses))
        text = (row["marker"] or "").strip()
        if not text.isdigit() or not 1 <= int(text) <= markers:
            raise InvalidParameter(
                f'{path}, line {line}: marker is "{text}"; it must be from 1 to {markers}'
            )
        place = (pose, int(text) - 1)
        if place in places:
            raise InvalidParameter(
                f"{path}, line {line}: marker {text} of pose {row['pose']} is given again; it "
                f"stands in line {places[place]}"
            )
        places[place] = line
    whole = np.full((2, len(poses), markers, len(file.sensors)), np.nan)
    for (pose, marker), line in places.items():
        whole[0, pose, marker] = readings[line - 2]
        if sigma is not None:
            whole[1, pose, marker] = sigma[line - 2]
    return ReadingTable(path, file.sensors, whole[0], None if sigma is None else whole[1])


class _File:
    """A CSV file with columns of readings, its sensors and rows."""

    def __init__(self, path: Path, required: tuple[str, ...]) -> None:
        self.path = path
        try:
            with path.open(newline="", encoding="utf-8-sig") as file:
                reader = csv.DictReader(file)
                self._columns = list(reader.fieldnames or ())
                self.rows = list(reader)
        except (OSError, UnicodeDecodeError) as error:
            raise InvalidParameter(f"{path} cannot be read as CSV: {error}") from error
        missing = [name for name in required if name not in self._columns]
        self.sensors = tuple(
            name.removesuffix(READING)
            for name in self._columns
            if name.endswith(READING) and not name.endswith(DEVIATION)
        )
        if missing or not self.sensors:
            what = f"column {missing[0]}" if missing else f"column of readings (NAME{READING})"
            raise InvalidParameter(
                f"{path} has no {what}; its columns are {', '.join(self._columns) or 'none'}, and "
                f"it needs {', '.join(required)} and NAME{READING} for each sensor"
            )

    def readings(self) -> tuple[Array, Array | None]:
        """Return readings (N, S) [px], NaN where empty, and sigma [px] where there is any."""
        deviations = [name + DEVIATION for name in self.sensors]
        given = [name for name in deviations if name in self._columns]
        if given and len(given) != len(self.sensors):
            absent = next(name for name in deviations if name not in self._columns)
            raise InvalidParameter(f"{self.path} has {given[0]} but no {absent}; give all or none")
        readings = self.numbers([name + READING for name in self.sensors], optional=True)
        return readings, self.numbers(deviations, optional=True) if given else None

    def numbers(self, names: list[str], *, optional: bool) -> Array:
        """Return columns as an array, shape (rows, names)."""
        return np.array(
            [
                [_number(self.path, line, name, row[name], optional=optional) for name in names]
                for line, row in enumerate(self.rows, start=2)
            ]
        ).reshape(len(self.rows), len(names))


def _number(path: Path, line: int, name: str, text: str | None, *, optional: bool) -> float:
    if optional and not (text or "").strip():
        return float("nan")
    try:
        return float(text or "")
    except ValueError:
        raise InvalidParameter(
            f'{path}, line {line}: {name} is "{text or ""}"; it must be a number'
        ) from None
