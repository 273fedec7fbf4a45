"""The thesis's measured and simulated tables, read from CSV files."""

import csv
from dataclasses import dataclass
from importlib.resources import files

import numpy as np
from numpy.typing import NDArray

from compute.camera.model import SensorGeometry
from validation.thesis_methods.dlt import CollinearityParameters

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PixelScale:
    """A sensor's pixels for readings that the thesis gives in mm from the sensor's edge.

    Args:
        name: the sensor's name.
        pitch_mm: pixel pitch.
        length_mm: length of the line of pixels.
        before_mm: length added before the thesis's edge.
    """

    name: str
    pitch_mm: float
    length_mm: float
    before_mm: float = 0.0

    @property
    def geometry(self) -> SensorGeometry:
        """The sensor's name and number of pixels."""
        return SensorGeometry(self.name, round((self.length_mm + self.before_mm) / self.pitch_mm))

    def to_px(self, readings_mm: Array) -> Array:
        """Convert readings [mm] to pixels, the centre of the first pixel at 0."""
        return (readings_mm + self.before_mm) / self.pitch_mm - 0.5

    def to_mm(self, position_px: float) -> float:
        """Convert a position [px] to mm from the thesis's edge."""
        return (position_px + 0.5) * self.pitch_mm - self.before_mm


_NAMES = ("cam1", "cam2", "cam3", "cam4")

LINEAR_CCD = tuple(PixelScale(name, 0.012, 24.576) for name in _NAMES)
"""Figure 5.2: 2048 pixels, 24.58 mm."""

DFW_V500 = tuple(
    PixelScale(name, 6.78 / 640, 6.78) if name == "cam2" else PixelScale(name, 5.08 / 480, 5.08)
    for name in _NAMES
)
"""Appendix G: 640 x 480 pixels on 6.78 x 5.08 mm; camera 2 reads along the longer side."""

LONG_DFW_V500 = tuple(
    PixelScale(scale.name, scale.pitch_mm, 40.0, before_mm=10.0) for scale in DFW_V500
)
"""For Tests 5.5 to 5.8: the generated values lie far outside the real sensor (Figure 5.11), so
they are read by a longer one."""


@dataclass(frozen=True, eq=False)
class PublishedTest:
    """One published test.

    Args:
        points_mm: given control points, shape (N, 3).
        readings_mm: published readings, rounded to 0.01 mm, shape (N, 4).
        reconstructed_mm: the thesis's reconstructed points, rounded to 0.1 mm, shape (N, 3).
    """

    points_mm: Array
    readings_mm: Array
    reconstructed_mm: Array


def load_test(number: str) -> PublishedTest:
    """Load the points of a test, ``"5.1"`` to ``"5.6"``."""
    rows = csv_rows(f"test_{number.replace('.', '_')}_points.csv")

    def columns(*names: str) -> Array:
        return np.array([[float(row[name]) for name in names] for row in rows])

    return PublishedTest(
        columns("X_mm", "Y_mm", "Z_mm"),
        columns("cam1_mm", "cam2_mm", "cam3_mm", "cam4_mm"),
        columns("X_dlt_mm", "Y_dlt_mm", "Z_dlt_mm"),
    )


def load_cameras(tests: str) -> tuple[CollinearityParameters, ...]:
    """Load the four cameras of ``"5.2"`` or ``"5.5 and 5.6"`` (Table 5.10), in mm."""
    chosen = [row for row in csv_rows("camera_parameters.csv") if row["test"] == tests]
    return tuple(
        CollinearityParameters(
            float(row["c_mm"]),
            float(row["p0_mm"]),
            (float(row["X0_mm"]), float(row["Y0_mm"]), float(row["Z0_mm"])),
            (float(row["L1"]), float(row["L2"]), float(row["L3"])),
            (float(row["L4"]), float(row["L5"]), float(row["L6"])),
        )
        for row in chosen
    )


def generate_readings(cameras: tuple[CollinearityParameters, ...], points_mm: Array) -> Array:
    """Project points (N, 3) by [5.18]-[5.19] without rounding, shape (N, 4) [mm].

    Written out from the equations, so that it does not share code with the camera under test.
    """
    columns = []
    for camera in cameras:
        relative = points_mm - np.array(camera.centre_mm)
        q = (relative @ np.array(camera.along)) / (relative @ np.array(camera.axis))
        columns.append(camera.p0 - camera.c * q)
    return np.column_stack(columns)


def csv_rows(name: str) -> list[dict[str, str]]:
    """Return the rows of a CSV file beside this module."""
    text = files("validation").joinpath("data", name).read_text(encoding="utf-8")
    return list(csv.DictReader(text.splitlines()))
