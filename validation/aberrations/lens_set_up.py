"""Set-up of Figure 3.16 and its fit to the measured readings of Table A.2."""

import csv
from dataclasses import dataclass, replace
from importlib.resources import files
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.optimize import least_squares

from compute.optics.pixel_row import PixelRow
from compute.optics.stripe_optics.stripe_profile import CELLS, Blur, StripeProfiles
from compute.optics.stripe_optics.traced_stripes import RaySampling, TracedStripes
from compute.optics.tracing.assembly import Alignment, Assembly
from validation.aberrations.thesis_lens import INDEX, LENS, THICKNESS_MM

Array = NDArray[np.float64]


Estimator = Literal["whole line", "third of the peak", "maximum", "chief ray"]

PITCH_UM: Final = 14.0

# Eight times the pitch, for lines of hundreds of pixels, and far longer than the sensor, so that
# nothing of them is cut off.
_COARSER: Final = 8

_ROW: Final = PixelRow(2048, _COARSER * PITCH_UM, PITCH_UM)

_SAMPLING: Final = RaySampling(17, 65, tolerance_px=0.02)

_SMOOTHED_PX: Final = 2.0  # before the maximum is looked for

_CENTRE_A2_PX: Final = 1024.0

CENTRE_A1_PX: Final = 1025.0

SOURCE_A2_MM: Final = 300.0

SOURCE_A1_MM: Final = 1500.0


@dataclass(frozen=True)
class SetUp:
    """What the text leaves open of the set-up of Figure 3.16.

    Args:
        sensor_mm: distance of the sensor from the back of the lens [mm].
        offset_mm: shift of the sensor along its pixels [mm].
        lens_tilt_rad: turn of the lens about its own axis [rad].
        sensor_tilt_rad: turn of the sensor about the same direction [rad].
    """

    sensor_mm: float
    offset_mm: float = 0.0
    lens_tilt_rad: float = 0.0
    sensor_tilt_rad: float = 0.0


STARTS: Final = (
    SetUp(27.0, 0.0, 0.0, -0.05),
    SetUp(25.0, -0.3, -0.03, 0.03),
)

_SCALES: Final = np.array([1.0, 0.3, 0.02, 0.02])  # mm, mm, rad, rad

_STEP: Final = 0.1  # of the scales

TILT_BOUND_RAD: Final = 0.1
"""No mount is farther off than 5.7 degrees."""

_LOWER_BOUNDS: Final = np.array([15.0, -3.0, -TILT_BOUND_RAD, -TILT_BOUND_RAD]) / _SCALES

_UPPER_BOUNDS: Final = np.array([40.0, 3.0, TILT_BOUND_RAD, TILT_BOUND_RAD]) / _SCALES

_EVERY: Final = 4


@dataclass(frozen=True, eq=False)
class Side:
    """The rows of Table A.2: lateral place, left positive [mm]; readings [px]."""

    lateral_mm: Array
    measured_px: Array
    predicted_px: Array
    left: NDArray[np.bool_]


def traced_px(
    set_up: SetUp, lateral_mm: Array, source_mm: float, estimator: Estimator, index: float = INDEX
) -> Array:
    """Return where the tracer sees a source, relative to the row's middle, shape (N,) [px].

    The lens of section 3.4, flat side towards the source, at its full width.
    """
    tilted = Alignment(tilt_rad=(0.0, set_up.lens_tilt_rad, 0.0))
    lens = replace(LENS, indices=(index,), alignment=tilted)
    sensor = Alignment((set_up.offset_mm, 0.0), (0.0, set_up.sensor_tilt_rad, 0.0))
    assembly = Assembly((lens,), THICKNESS_MM + set_up.sensor_mm, sensor)
    # An emitter's size and diffraction are nothing beside this lens's own blur.
    lines = TracedStripes(assembly, _ROW, Blur(None, 0.0), _SAMPLING)
    points = np.stack(
        [lateral_mm, np.zeros_like(lateral_mm), np.full_like(lateral_mm, source_mm)], axis=1
    )
    if estimator == "chief ray":
        return _COARSER * (lines.chief_px(points) - _ROW.centre_px)
    return _COARSER * (_position(lines.shapes(points), estimator) - _ROW.centre_px)


def _position(shapes: StripeProfiles, estimator: Estimator) -> Array:
    if estimator == "whole line":
        return shapes.centroid_px
    light = gaussian_filter1d(shapes.cell_sr, _SMOOTHED_PX * CELLS / _COARSER, axis=1)
    peak = light.max(axis=1, keepdims=True)
    if estimator == "maximum":
        return np.take_along_axis(
            shapes.centres_px, light.argmax(axis=1, keepdims=True), axis=1
        ).ravel()
    # Section 4.2.2: a third of the maximum for active targets, then [4.1].
    above = np.where(light > peak / 3.0, light, 0.0)
    centroid: Array = (above * shapes.centres_px).sum(axis=1) / above.sum(axis=1)
    return centroid


def table_a2() -> Side:
    """Return Table A.2; the predicted 0.0 of the last row of each side is left out as NaN."""
    rows = csv_rows_of("table_A2_measured_distortion.csv")
    left = np.array([row["side"] == "left" for row in rows])
    lateral = np.array([float(row["distance_mm"]) for row in rows])
    predicted = np.array([float(row["predicted_px"]) for row in rows])
    return Side(
        np.where(left, lateral, -lateral),
        np.array([float(row["measured_px"]) for row in rows]),
        np.where(predicted == 0.0, np.nan, predicted),
        left,
    )


def fit_set_up(
    estimator: Estimator, index: float = INDEX, starts: tuple[SetUp, ...] = STARTS
) -> tuple[SetUp, Array]:
    """Fit the four parameters of the set-up to both sides of Table A.2 at once.

    Every fourth row is fitted from each start, all rows from the best of what comes out.

    Returns:
        The set-up and the residuals, traced less measured, in the order of the table [px].
    """
    table = table_a2()
    rows = np.arange(0, len(table.left), _EVERY)
    found = [_fitted(start, estimator, index, table, rows) for start in starts]
    best = min(found, key=lambda one: rms(one[1]))[0]
    return _fitted(best, estimator, index, table, np.arange(len(table.left)))


def _fitted(
    start: SetUp, estimator: Estimator, index: float, table: Side, rows: NDArray[np.int64]
) -> tuple[SetUp, Array]:
    # Both sides were counted downwards from 1024: on the right the image went the other way.
    sign = np.where(table.left, 1.0, -1.0)[rows]
    measured = sign * (_CENTRE_A2_PX - table.measured_px[rows])

    def residuals(scaled: Array) -> Array:
        set_up = SetUp(*(float(value) for value in scaled * _SCALES))
        seen = traced_px(set_up, table.lateral_mm[rows], SOURCE_A2_MM, estimator, index)
        # A source whose light misses the row altogether counts as far off.
        return np.nan_to_num(seen - measured, nan=1e3)

    def slopes(scaled: Array) -> Array:
        # Steps as wide as the caustics' edges need: the line's place is not quite smooth.
        steps = _STEP * np.eye(len(scaled))
        inside = [
            np.clip(scaled + sign * step, _LOWER_BOUNDS, _UPPER_BOUNDS)
            for step in steps
            for sign in (1, -1)
        ]
        seen = [residuals(position) for position in inside]
        return np.stack(
            [
                (seen[2 * k] - seen[2 * k + 1]) / (inside[2 * k][k] - inside[2 * k + 1][k])
                for k in range(len(scaled))
            ],
            axis=1,
        )

    first = np.array([start.sensor_mm, start.offset_mm, start.lens_tilt_rad, start.sensor_tilt_rad])
    fitted = least_squares(
        residuals,
        first / _SCALES,
        slopes,
        bounds=(_LOWER_BOUNDS, _UPPER_BOUNDS),
        ftol=1e-3,
        max_nfev=10,
    )
    return SetUp(*(float(value) for value in fitted.x * _SCALES)), fitted.fun


def csv_rows_of(name: str) -> list[dict[str, str]]:
    """Return the rows of a CSV file of ``validation/data``."""
    text = (files("validation") / "data" / name).read_text(encoding="utf-8")
    return list(csv.DictReader(text.splitlines()))


def rms(values: Array) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(values**2)))
