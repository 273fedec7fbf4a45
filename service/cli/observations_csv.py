"""Control points and readings in a CSV file: one row a point, one column a sensor."""

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter

Array = NDArray[np.float64]

POSITION = ("X_mm", "Y_mm", "Z_mm")
READING, DEVIATION = "_px", "_sigma_px"


@dataclass(frozen=True, eq=False)
class ObservationTable:
    """What the file holds.

    Args:
        points_mm: shape (N, 3).
        sensors: names of the S sensors, in the order of their columns.
        readings_px: shape (N, S), NaN where the cell is empty.
        sigma_px: shape (N, S), or None when the file has no deviations.
    """

    points_mm: Array
    sensors: tuple[str, ...]
    readings_px: Array
    sigma_px: Array | None


def read_observations(path: Path) -> ObservationTable:
    """Read columns ``X_mm, Y_mm, Z_mm``, and for each sensor ``NAME_px`` [, ``NAME_sigma_px``].

    Other columns are left alone; an empty reading means that the sensor did not see the point.

    Raises:
        InvalidParameter: a column is missing, or a cell is not a number.
    """
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file)
            columns = list(reader.fieldnames or ())
            rows = list(reader)
    except (OSError, UnicodeDecodeError) as error:
        raise InvalidParameter(f"{path} cannot be read as CSV: {error}") from error
    missing = [name for name in POSITION if name not in columns]
    sensors = tuple(
        name.removesuffix(READING)
        for name in columns
        if name.endswith(READING) and not name.endswith(DEVIATION)
    )
    if missing or not sensors:
        what = f"column {missing[0]}" if missing else f"column of readings (NAME{READING})"
        raise InvalidParameter(
            f"{path} has no {what}; its columns are {', '.join(columns) or 'none'}, and it needs "
            f"{', '.join(POSITION)} and NAME{READING} for each sensor"
        )
    deviations = [name + DEVIATION for name in sensors]
    given = [name for name in deviations if name in columns]
    if given and len(given) != len(sensors):
        absent = next(name for name in deviations if name not in columns)
        raise InvalidParameter(f"{path} has {given[0]} but no {absent}; give all or none")

    def numbers(names: list[str], *, optional: bool) -> Array:
        return np.array(
            [
                [_number(path, line, name, row[name], optional=optional) for name in names]
                for line, row in enumerate(rows, start=2)
            ]
        ).reshape(len(rows), len(names))

    return ObservationTable(
        numbers(list(POSITION), optional=False),
        sensors,
        numbers([name + READING for name in sensors], optional=True),
        numbers(deviations, optional=True) if given else None,
    )


def _number(path: Path, line: int, name: str, text: str | None, *, optional: bool) -> float:
    if optional and not (text or "").strip():
        return float("nan")
    try:
        return float(text or "")
    except ValueError:
        raise InvalidParameter(
            f'{path}, line {line}: {name} is "{text or ""}"; it must be a number'
        ) from None
