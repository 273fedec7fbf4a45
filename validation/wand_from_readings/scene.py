"""Random bars of sensors and a waved wand; an own projection, which shares no code with compute."""

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

Directions = Literal[
    "all", "all parallel", "all in one plane", "on a cone", "flat cloud", "one end fixed"
]
DIRECTION_ERROR_RAD: Final = 0.2
"""Standard deviation of the described directions of the pixels: a glance at the device."""


@dataclass(frozen=True, eq=False)
class Bar:
    """Sensors on a bar that look at one volume.

    Args:
        pixels: of each sensor.
        distance_px: principal distances, shape (S,) [px].
        point_px: principal points, shape (S,) [px].
        rotation: rows right, down, forward of each sensor, shape (S, 3, 3).
        lens_mm: shape (S, 3) [mm].
        distortion: of u^3, u v^2 and u^5, shape (S, 3).
        centre_mm: centre of the volume, shape (3,) [mm].
        side_mm: side of the volume [mm].
        wand_mm: distance of the wand's markers [mm].
    """

    pixels: int
    distance_px: Array
    point_px: Array
    rotation: Array
    lens_mm: Array
    distortion: Array
    centre_mm: Array
    side_mm: float
    wand_mm: float

    def read(self, points_mm: Array) -> Array:
        """Return exact readings (..., S) of points (..., 3), NaN beside the pixels [px]."""
        away = points_mm[..., None, :] - self.lens_mm
        x, y, z = np.moveaxis(np.einsum("sij,...sj->...si", self.rotation, away), -1, 0)
        u, v = x / z, y / z
        cubic, skew, fifth = self.distortion.T
        bent = u + cubic * u**3 + skew * u * v**2 + fifth * u**5
        position = self.point_px + self.distance_px * bent
        return np.where((position >= 0.0) & (position <= self.pixels - 1.0), position, np.nan)


@dataclass(frozen=True, eq=False)
class Wave:
    """A waved wand as the sensors read it.

    Args:
        bar: the device.
        markers_mm: the true ends, shape (B, 2, 3) [mm].
        readings_px: shape (B, 2, S) [px]; NaN where not seen.
        sigma_px: noise [px].
        directions_deg: the described directions of the pixels, shape (S,) [degrees].
    """

    bar: Bar
    markers_mm: Array
    readings_px: Array
    sigma_px: float
    directions_deg: tuple[float, ...]


def random_bar(rng: np.random.Generator, sensors: int, *, distorted: bool) -> Bar:
    """Return a bar of 0.6 to 1.2 m, 1.5 to 2.5 m before the volume, slits at mixed angles.

    Args:
        rng: source of randomness.
        sensors: number of sensors, S.
        distorted: with lenses that move the light at the field's edge by 0.2 to 2 % of it.
    """
    pixels = int(rng.integers(2048, 4097))
    field = np.tan(np.deg2rad(rng.uniform(15.0, 35.0)))
    distance, length = rng.uniform(1500.0, 2500.0), rng.uniform(600.0, 1200.0)
    centre = np.array([0.0, 0.0, distance])
    side = distance * field
    along = np.linspace(-0.5 * length, 0.5 * length, sensors)
    lens = np.column_stack([along, np.zeros((sensors, 2))]) + rng.normal(0.0, 20.0, (sensors, 3))
    forward = centre + rng.normal(0.0, 40.0, (sensors, 3)) - lens
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    level = np.cross([0.0, 1.0, 0.0], forward)
    level /= np.linalg.norm(level, axis=1, keepdims=True)
    down = np.cross(forward, level)
    roll = rng.permutation(sensors) * np.pi / sensors + rng.uniform(0.0, np.pi)
    roll = (roll + rng.normal(0.0, 0.15, sensors) + np.pi * rng.integers(0, 2, sensors))[:, None]
    right = np.cos(roll) * level + np.sin(roll) * down
    bent = np.zeros((sensors, 3))
    if distorted:
        lenses = rng.uniform(0.002, 0.02) * np.array([rng.choice([-1.0, 1.0]), 1.5, 0.3])
        bent = lenses * (1.0 + rng.normal(0.0, 0.1, (sensors, 3)))
        bent /= np.array([field**2, field**2, field**4])
    return Bar(
        pixels,
        0.5 * pixels / field * rng.uniform(0.95, 1.05, sensors),
        0.5 * (pixels - 1) + rng.normal(0.0, 0.02 * pixels, sensors),
        np.stack([right, np.cross(forward, right), forward], axis=1),
        lens,
        bent,
        centre,
        side,
        min(rng.uniform(200.0, 500.0), 0.7 * side),
    )


def random_wave(
    rng: np.random.Generator,
    bar: Bar,
    *,
    poses: int,
    sigma_px: float,
    missing: float,
    wrong: float,
    exchanged: float,
    directions: Directions = "all",
) -> Wave:
    """Return what a bar reads of a wand at random positions, in all directions.

    Args:
        rng: source of randomness.
        bar: the device.
        poses: number of poses.
        sigma_px: noise [px].
        missing: share of readings that are missing.
        wrong: share of readings that are anywhere on the pixels.
        exchanged: share of a sensor's poses in which it has the ends exchanged.
        directions: of the wand: all, or those of a degenerate wave; "flat cloud": positions and
            directions in one plane; "one end fixed": all over the sphere about one point.
    """
    centre = bar.centre_mm + rng.uniform(-0.5, 0.5, (poses, 3)) * bar.side_mm
    half = rng.standard_normal((poses, 3))
    if directions == "all parallel":
        half[:] = half[0]
    elif directions == "all in one plane":
        normal = rng.standard_normal(3)
        half -= np.outer(half @ normal, normal) / (normal @ normal)
    elif directions == "on a cone":
        half[:, 2] = 0.7 * np.linalg.norm(half[:, :2], axis=1)
    elif directions == "flat cloud":
        normal = np.append(0.3 * rng.standard_normal(2), 1.0)
        normal /= np.linalg.norm(normal)
        half -= np.outer(half @ normal, normal)
        centre -= np.outer((centre - bar.centre_mm) @ normal, normal)
    half *= 0.5 * bar.wand_mm / np.linalg.norm(half, axis=1, keepdims=True)
    if directions == "one end fixed":
        centre = bar.centre_mm + half
    markers = np.stack([centre - half, centre + half], axis=1)
    exact = bar.read(markers)
    read = exact + rng.normal(0.0, sigma_px, exact.shape)
    swapped = rng.random((poses, 1, exact.shape[2])) < exchanged
    read = np.where(swapped, read[:, ::-1], read)
    anywhere = rng.uniform(0.0, bar.pixels - 1.0, read.shape)
    read = np.where(rng.random(read.shape) < wrong, anywhere, read)
    unseen = np.isnan(exact) | (rng.random(read.shape) < missing)
    read = np.where(unseen, np.nan, np.clip(read, -0.4, bar.pixels - 0.6))
    angle = np.arctan2(bar.rotation[:, 0, 1], bar.rotation[:, 0, 0])
    angle += rng.normal(0.0, DIRECTION_ERROR_RAD, len(angle))
    return Wave(bar, markers, read, sigma_px, tuple(np.rad2deg(angle).tolist()))
