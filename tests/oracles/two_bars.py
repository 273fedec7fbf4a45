"""Two bars in a hall: a moving marker at each bar's own exposures, and points with clock errors.

Written from the geometry alone, without any code of the project.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from tests.oracles.ideal_sensors import IdealSensor, aimed_sensor

Array = NDArray[np.float64]

CENTRE = np.array([0.0, 0.0, 2500.0])
RADIUS = 300.0
RATE_HZ = 500.0
OFFSET_S = 200e-6
SKEW = 1e-4
"""Of the second bar's clock."""
LAYOUT = tuple(
    (position, angle)
    for ends in (
        ((-300.0, 0.0, 0.0), (300.0, 0.0, 0.0)),
        ((2500.0, 0.0, 2200.0), (2500.0, 0.0, 2800.0)),
    )
    for position, angle in zip(
        np.linspace(ends[0], ends[1], 4), np.pi / 4.0 * np.arange(4), strict=True
    )
)
"""Position and angle of the rows of four sensors of one bar, then of the other."""


def sensors() -> list[IdealSensor]:
    """Return the eight sensors."""
    return [aimed_sensor(position, CENTRE, float(angle)) for position, angle in LAYOUT]


def course(time_s: Array, speed_mm_s: float) -> Array:
    """Return where a marker is on a tilted circle at times (N,), shape (N, 3) [mm]."""
    angle = speed_mm_s / RADIUS * np.asarray(time_s)
    across = np.array([np.cos(0.4), np.sin(0.4), 0.0])
    up = np.array([0.0, 0.0, 1.0])
    return CENTRE + RADIUS * (np.cos(angle)[:, None] * across + np.sin(angle)[:, None] * up)


def read(sensors_of_bar: list[IdealSensor], points: Array) -> Array:
    """Return the readings of points (N, 3), shape (N, S)."""
    return np.stack([one.read(points) for one in sensors_of_bar], axis=1)


@dataclass(frozen=True)
class HallRun:
    """A marker before both bars, with noise.

    Args:
        time_s: true times of the first bar's exposures, whose clock is the reference, (N,) [s].
        position_mm: of the marker then, shape (N, 3).
        first_px: readings of the first bar then, shape (N, 4).
        second_stated_s: times of the second bar's exposures as they are known, shape (N,).
        second_px: its readings, shape (N, 4).
        together_px: readings of all eight sensors, if they were exposed with the first, (N, 8).
    """

    time_s: Array
    position_mm: Array
    first_px: Array
    second_stated_s: Array
    second_px: Array
    together_px: Array


def draw(
    rng: np.random.Generator, count: int, speed_mm_s: float, sigma_px: float, clock_error_s: float
) -> HallRun:
    """Draw a run; the second bar's clock is corrected but for ``clock_error_s``."""
    time_s = np.arange(count) / RATE_HZ
    clock = np.arange(count) / RATE_HZ + rng.uniform() / RATE_HZ
    second_s = (clock - OFFSET_S) / (1.0 + SKEW)
    both = sensors()
    position = course(time_s, speed_mm_s)

    def noisy(readings: Array) -> Array:
        return readings + sigma_px * rng.standard_normal(readings.shape)

    return HallRun(
        time_s,
        position,
        noisy(read(both[:4], position)),
        second_s + clock_error_s,
        noisy(read(both[4:], course(second_s, speed_mm_s))),
        noisy(read(both, position)),
    )


def point_and_clock(
    readings_px: Array,
    sigma_px: Array,
    rate_px_s: Array,
    late: NDArray[np.bool_],
    clock_sigma_s: float,
    start_mm: Array,
) -> tuple[Array, float, Array, float]:
    """Fit a point and the error of the second clock together.

    Args:
        readings_px: shape (S,).
        sigma_px: shape (S,).
        rate_px_s: shape (S,).
        late: which sensors are timed by the clock, shape (S,).
        clock_sigma_s: deviation of its error.
        start_mm: where to begin, shape (3,).

    Returns:
        The point, the clock's error [s], their covariance (4, 4), and the sum of squares.
    """
    every = sensors()
    scale = 1e-6

    def misses(unknown: Array) -> Array:
        error_s = scale * unknown[3]
        predicted = read(every, unknown[None, :3])[0] - rate_px_s * late * error_s
        return np.append((predicted - readings_px) / sigma_px, error_s / clock_sigma_s)

    fit = least_squares(
        misses, np.append(start_mm, 0.0), jac="3-point", xtol=1e-15, ftol=1e-15, gtol=1e-15
    )
    covariance = np.linalg.inv(fit.jac.T @ fit.jac)
    units = np.array([1.0, 1.0, 1.0, scale])
    return fit.x[:3], scale * fit.x[3], covariance * units * units[:, None], 2.0 * fit.cost
