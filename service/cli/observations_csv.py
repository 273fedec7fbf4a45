"""Reads a CSV file of readings, one column a sensor: control points or a moved wand."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray
from rich.markup import escape

from compute.camera.model import SensorGeometry, SensorModel
from compute.errors import InvalidParameter
from service.cli.output import hint
from service.cli.spreadsheet import Cell, NumberFormat, read_spreadsheet

Array = NDArray[np.float64]

POSITION = ("X_mm", "Y_mm", "Z_mm")
POSE_COLUMNS = ("pose", "marker")

POWERS = {
    "mm": 0,
    "cm": 1,
    "m": 3,
    "um": -3,
    "\N{MICRO SIGN}m": -3,
    "\N{GREEK SMALL LETTER MU}m": -3,
}
"""Powers of ten from a unit of length in a heading to mm."""

# As spreadsheets, R and MATLAB write them: X_mm, x [mm], X (mm), x/mm, X in mm, X..mm., X_mm_.
_UNIT = r"[\s_.,/\[(]+(?:in\s+)?{}[\s_.\])]*"
_LENGTH = re.compile("([xyz])" + _UNIT.format("(" + "|".join(POWERS) + ")"), re.IGNORECASE)
_READING = re.compile("(.*[^\\s_.,/\\[(])" + _UNIT.format("(?:px|pixels?)"), re.IGNORECASE)
_SIGMA = re.compile(r"(.+?)[\s_.,]+sigma", re.IGNORECASE)


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

    def in_order_of(
        self,
        sensors: Sequence[SensorModel] | Sequence[SensorGeometry],
        source: str = "the calibration",
    ) -> Self:
        """Return the readings in the order of these sensors; raises InvalidParameter."""
        names = tuple(sensor.name for sensor in sensors)
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
        labels: of the points: their names, or their numbers from 1 where the file has no names.
    """

    points_mm: Array
    labels: tuple[str, ...]


def read_observations(path: Path) -> ObservationTable:
    """Read columns ``X_mm, Y_mm, Z_mm``, and for each sensor ``NAME_px`` [, ``NAME_sigma_px``].

    Coordinates may be in other units of POWERS. A column ``name`` has the points' labels. Other
    columns are not used; those of numbers are named on standard error. An empty reading means that
    the sensor did not see the point.

    Raises:
        InvalidParameter: a column is missing, a cell is not a number, or a column that is not used
            is called like a sensor.
    """
    file = _File(path, POSITION)
    readings, sigma, points = file.numbers()
    if np.isnan(points).any():
        row, axis = (int(index) for index in np.argwhere(np.isnan(points))[0])
        cell = file.cells(POSITION[axis])[row]
        raise InvalidParameter(
            f'{path}, line {cell.line}: {cell.heading} is "{cell.text}"; it must be a number'
        )
    named = [cell.text for cell in file.cells("name")] if "name" in file.columns else []
    labels = [text or str(number) for number, text in enumerate(named, 1)]
    numbers = [str(number) for number in range(1, len(points) + 1)]
    return ObservationTable(path, file.sensors, readings, sigma, points, tuple(labels or numbers))


def read_wand(path: Path, markers: int) -> ReadingTable:
    """Read columns ``pose, marker`` (from 1), and for each sensor ``NAME_px`` [, sigma].

    Poses are told apart by their text and kept in the order in which they first come. Other
    columns are as in ``read_observations``.

    Raises:
        InvalidParameter: a column is missing, a cell is not a number, a marker that the wand has
            not got, a pose's marker given twice, or a column that is not used is called like a
            sensor.
    """
    file = _File(path, POSE_COLUMNS)
    readings, sigma, _ = file.numbers()
    poses: dict[str, int] = {}
    line_of: dict[tuple[int, int], int] = {}
    rows: dict[tuple[int, int], int] = {}
    for row, (pose_cell, marker) in enumerate(
        zip(file.cells("pose"), file.cells("marker"), strict=True)
    ):
        line, text = marker.line, marker.text
        pose = poses.setdefault(pose_cell.text, len(poses))
        if not text.isdigit() or not 1 <= int(text) <= markers:
            raise InvalidParameter(
                f'{path}, line {line}: marker is "{text}"; it must be from 1 to {markers}'
            )
        pose_marker = (pose, int(text) - 1)
        if pose_marker in line_of:
            raise InvalidParameter(
                f"{path}, line {line}: marker {text} of pose {pose_cell.text} is given again; it "
                f"stands in line {line_of[pose_marker]}"
            )
        line_of[pose_marker] = line
        rows[pose_marker] = row
    table = np.full((2, len(poses), markers, len(file.sensors)), np.nan)
    for pose_marker, row in rows.items():
        table[0][pose_marker] = readings[row]
        if sigma is not None:
            table[1][pose_marker] = sigma[row]
    return ReadingTable(path, file.sensors, table[0], None if sigma is None else table[1])


class _File:
    """A spreadsheet with columns of readings.

    Args:
        path: the file.
        required: columns that it must have.

    Attributes:
        columns: by the name that this module gives it, the index of each column that is used.
        sensors: names of the sensors, in the order of their columns.
    """

    def __init__(self, path: Path, required: tuple[str, ...]) -> None:
        self._sheet = sheet = read_spreadsheet(path)
        self.columns: dict[str, int] = {}
        self._powers = dict.fromkeys(POSITION, 0)
        for index, heading in enumerate(sheet.headings):
            name, power = _recognise(heading)
            if name in self.columns:
                raise InvalidParameter(
                    f'{path} has the columns "{sheet.headings[self.columns[name]]}" (number '
                    f'{self.columns[name] + 1}) and "{heading}" (number {index + 1}), which both '
                    f"give {name}; rename or delete one"
                )
            if name:
                self.columns[name] = index
                self._powers[name] = power
        readings = [name.removesuffix("_px") for name in self.columns if name.endswith("_px")]
        self.sensors = tuple(name for name in readings if not name.endswith("_sigma"))
        missing = [name for name in required if name not in self.columns]
        if missing or not self.sensors:
            what = f"column {missing[0]}" if missing else "column of readings (NAME_px)"
            lengths = "; X, Y, Z may be in m, cm, mm or um" if required == POSITION else ""
            raise InvalidParameter(
                f"{path} has no {what}; its columns are {', '.join(sheet.headings) or 'none'}, and "
                f"it needs {', '.join(required)} and NAME_px for each sensor, separated by commas, "
                f"semicolons or tabs{lengths}"
            )
        self._sigma = [f"{name}_sigma_px" for name in self.sensors]
        expected = [f"{name}_px" for name in readings if name.endswith("_sigma")]
        absent = [name for name in self._sigma if name not in expected]
        orphans = [name for name in expected if name not in self._sigma]
        if orphans:
            raise InvalidParameter(
                f"{path} has {orphans[0]} but no {orphans[0].replace('_sigma', '')}; its sensors "
                f"are {', '.join(self.sensors)}"
            )
        if expected and absent:
            raise InvalidParameter(f"{path} has {expected[0]} but no {absent[0]}; give all or none")
        if not expected:
            self._sigma = []
        self._positions = [name for name in POSITION if name in required]
        used = [*self._positions, *self._sigma, *(f"{name}_px" for name in self.sensors)]
        self._format = NumberFormat(sheet, (cell for name in used for cell in self.cells(name)))
        self._report_unused({*used, *required, *(("name",) if required == POSITION else ())})

    def _report_unused(self, used: set[str]) -> None:
        """Name the columns of numbers that are not used; raises InvalidParameter for a reading."""
        indices = {self.columns[name] for name in used if name in self.columns}
        unused = [
            heading
            for index, heading in enumerate(self._sheet.headings)
            if index not in indices
            and heading
            and any(row[index].numeric for row in self._sheet.rows)
            and all(row[index].numeric or row[index].missing for row in self._sheet.rows)
        ]
        patterns = {_pattern(name): name for name in reversed(self.sensors)}
        for heading in unused:
            if _pattern(heading) in patterns:
                raise InvalidParameter(
                    f'{self._sheet.path} has numbers in the column "{heading}", which is called '
                    f"like the sensor {patterns[_pattern(heading)]} but is not said to be in "
                    f"pixels; call it {heading}_px if it has readings, or else delete it"
                )
        if unused:
            what = "columns" if len(unused) > 1 else "column"
            hint(
                f"{self._sheet.path}: the numbers in the {what} {escape(', '.join(unused))} are "
                "not used; "
                "the heading of readings ends in _px"
            )

    def cells(self, name: str) -> list[Cell]:
        """Return the cells of a column."""
        return [row[self.columns[name]] for row in self._sheet.rows]

    def numbers(self) -> tuple[Array, Array | None, Array]:
        """Return readings (N, S), their sigma or None, and positions (N, 3); NaN where empty."""
        readings = self._array([f"{name}_px" for name in self.sensors])
        positions = self._array(self._positions)
        return readings, self._array(self._sigma) if self._sigma else None, positions

    def _array(self, names: list[str]) -> Array:
        columns = [
            [self._format.number(cell, self._powers[name]) for cell in self.cells(name)]
            for name in names
        ]
        return np.array(columns).reshape(len(names), len(self._sheet.rows)).T.copy()


def _pattern(name: str) -> str:
    """Return what names of one series have in common: cam1 and Cam 12, a and B."""
    letters = re.sub(r"[\s_.-]", "", name.lower())
    return "?" if len(letters) == 1 and letters.isalpha() else re.sub(r"\d+", "#", letters)


def _recognise(heading: str) -> tuple[str, int]:
    """Return the name of a column that is used, and its power of ten; an empty name: it is not."""
    reading = _READING.fullmatch(heading)
    if reading:
        sigma = _SIGMA.fullmatch(reading[1])
        return (f"{sigma[1]}_sigma_px" if sigma else f"{reading[1]}_px"), 0
    length = _LENGTH.fullmatch(heading)
    if length:
        return f"{length[1].upper()}_mm", POWERS[length[2].lower()]
    name = heading.lower()
    return (name if name in (*POSE_COLUMNS, "name") else ""), 0
