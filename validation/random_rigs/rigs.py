"""Random rigs of linear sensors with their own projection, noise and missing readings.

Nothing here uses the cameras of ``compute``: what judges the calibration shares no code with it.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

PIXELS: Final = (1024, 2048, 4096)
HALF_FIELD_DEG: Final = (8.0, 50.0)
VOLUME_MM: Final = (200.0, 1500.0)
DISTORTION: Final = (0.002, 0.02)
"""Size of the cubic term at the field's edge, as a share of half the field."""
LENS_SCATTER: Final = 0.1
"""Relative difference between the lenses of a device."""


@dataclass(frozen=True, eq=False)
class Rig:
    """Sensors around a volume.

    Args:
        pixels: of each sensor.
        axes: of the sensors' frames (along the row, along the slit, forward), shape (S, 3, 3).
        lenses_mm: positions of the lenses, shape (S, 3).
        distance_px: principal distances, shape (S,).
        centre_px: principal points, shape (S,).
        coefficients: of u^3, u v^2, v^2 and u^5, shape (S, 4).
        volume_centre_mm: shape (3,).
        side_mm: of the cubic volume.
    """

    pixels: int
    axes: Array
    lenses_mm: Array
    distance_px: Array
    centre_px: Array
    coefficients: Array
    volume_centre_mm: Array
    side_mm: float

    @property
    def sensors(self) -> int:
        """Number of sensors."""
        return len(self.lenses_mm)

    def points(self, rng: np.random.Generator, count: int, share: float = 1.0) -> Array:
        """Return random points of the volume, (count, 3) [mm].

        Args:
            rng: the generator.
            count: number of points.
            share: part of the volume's side within which they lie.
        """
        return self.volume_centre_mm + rng.uniform(-0.5, 0.5, (count, 3)) * self.side_mm * share

    def read(self, points_mm: Array) -> Array:
        """Return exact readings (N, S) [px]; NaN beyond the row of pixels."""
        readings = np.empty((len(points_mm), self.sensors))
        for k in range(self.sensors):
            x, y, z = self.axes[k] @ (points_mm - self.lenses_mm[k]).T
            u, v = x / z, y / z
            a, b, c, d = self.coefficients[k]
            bent = u + a * u**3 + b * u * v**2 + c * v**2 + d * u**5
            readings[:, k] = self.centre_px[k] + self.distance_px[k] * bent
        return np.where((readings < 0.0) | (readings > self.pixels - 1.0), np.nan, readings)


@dataclass(frozen=True, eq=False)
class Trial:
    """A rig, its control points, and how they were read.

    Args:
        rig: the rig.
        distorted: whether its lenses distort.
        control_mm: coordinates of the control points as they are known, shape (N, 3).
        readings_px: shape (N, S); NaN where missing.
        noise_px: standard deviation of a reading.
        position_sigma_mm: standard deviation of a known coordinate; 0: exact.
        noise_given: whether calibration is told the noise.
    """

    rig: Rig
    distorted: bool
    control_mm: Array
    readings_px: Array
    noise_px: float
    position_sigma_mm: float
    noise_given: bool

    @property
    def fewest_readings(self) -> int:
        """Readings of the sensor that has fewest."""
        return int(np.isfinite(self.readings_px).sum(axis=0).min())


def random_rig(rng: np.random.Generator, distorted: bool) -> Rig:
    """Return 3 to 8 sensors that look at a volume from one side, their rows turned evenly."""
    sensors = int(rng.integers(3, 9))
    half = float(np.tan(np.deg2rad(np.exp(rng.uniform(*np.log(HALF_FIELD_DEG))))))
    pixels = int(rng.choice(PIXELS))
    side = float(np.exp(rng.uniform(*np.log(VOLUME_MM))))
    distance = side * (0.5 + 0.675 / half)
    centre = rng.normal(0.0, 200.0, 3)
    first_roll = rng.uniform(0.0, np.pi)
    axes, lenses = [], []
    for k in range(sensors):
        direction = np.array([*rng.uniform(-0.6, 0.6, 2), -1.0])
        direction /= np.linalg.norm(direction)
        lens = centre + direction * distance * rng.uniform(0.95, 1.15)
        forward = centre + rng.normal(0.0, 0.03 * side, 3) - lens
        roll = first_roll + k * np.pi / sensors + rng.normal(0.0, 0.1)
        axes.append(_axes(forward / np.linalg.norm(forward), roll))
        lenses.append(lens)
    coefficients = np.zeros((sensors, 4))
    if distorted:
        size = rng.uniform(*DISTORTION)
        lens = size * np.array(
            [
                rng.choice([-1.0, 1.0]),
                rng.uniform(0.75, 2.25),
                rng.uniform(-0.03, 0.03),
                rng.uniform(-0.3, 0.3),
            ]
        )
        scatter = 1.0 + rng.normal(0.0, LENS_SCATTER, (sensors, 4))
        coefficients = lens * scatter / np.array([half**2, half**2, half, half**4])
    return Rig(
        pixels,
        np.array(axes),
        np.array(lenses),
        0.5 * pixels / half * rng.uniform(0.95, 1.05, sensors),
        0.5 * (pixels - 1) + rng.normal(0.0, 0.01 * pixels, sensors),
        coefficients,
        centre,
        side,
    )


def _axes(forward: Array, roll: float) -> Array:
    """Return the frame of a sensor as rows: along the row, along the slit, forward."""
    across = np.cross([0.0, 1.0, 0.0] if abs(forward[1]) < 0.9 else [1.0, 0.0, 0.0], forward)
    across /= np.linalg.norm(across)
    other = np.cross(forward, across)
    row = np.cos(roll) * across + np.sin(roll) * other
    return np.array([row, np.cross(forward, row), forward])


def random_trial(rng: np.random.Generator) -> Trial:
    """Return a rig with 12 to 300 control points, read once."""
    distorted = bool(rng.random() < 0.5)
    rig = random_rig(rng, distorted)
    count = int(np.exp(rng.uniform(np.log(12.0), np.log(300.0))))
    noise = float(np.exp(rng.uniform(np.log(0.05), np.log(1.0))))
    control = 0.0 if rng.random() < 0.4 else float(rng.uniform(0.01, 0.5))
    missing = 0.0 if rng.random() < 0.4 else float(rng.uniform(0.0, 0.3))
    points = rig.points(rng, count)
    readings = rig.read(points)
    readings = readings + rng.normal(0.0, noise, readings.shape)
    readings[rng.random(readings.shape) < missing] = np.nan
    readings[(readings < -0.5) | (readings > rig.pixels - 0.5)] = np.nan
    seen = np.isfinite(readings).any(axis=1)
    known = points + rng.normal(0.0, 1.0, points.shape) * control
    given = bool(rng.random() < 0.5)
    return Trial(rig, distorted, known[seen], readings[seen], noise, control, given)
