"""Scene of the tracking benchmark: markers that cross smoothly before line sensors."""

from dataclasses import dataclass
from math import cos, pi, sin

import numpy as np
from numpy.typing import NDArray

from compute.camera.stack import CameraStack
from compute.optics.sensor_placement import place_sensor

Array = NDArray[np.float64]

PIXELS = 2048
SIGMA_PX = 0.05
MERGE_PX = 4.0
"""Two markers' peaks nearer than this are one, somewhere between the two."""
RATE_HZ = 100.0
MISSED = 0.05
FALSE_SHARE = 0.05
"""False peaks, in parts of the markers."""
CENTRE_MM = np.array([0.0, 0.0, 1500.0])


@dataclass(frozen=True, eq=False)
class Scene:
    """F exposures of N markers by S sensors.

    Args:
        cameras: S of them.
        times_s: shape (F,).
        positions_mm: true ones, shape (F, N, 3).
        velocity_mm_s: true ones, shape (F, N, 3).
        peaks_px: of each exposure, (S, K); NaN where there are fewer.
        clutter_density_per_px: density of false peaks [1/px].
    """

    cameras: CameraStack
    times_s: Array
    positions_mm: Array
    velocity_mm_s: Array
    peaks_px: tuple[Array, ...]
    clutter_density_per_px: float


@dataclass(frozen=True, eq=False)
class Starts:
    """Initial states of N markers at an exposure: position and velocity.

    Args:
        position_mm: shape (N, 3).
        velocity_mm_s: shape (N, 3).
    """

    position_mm: Array
    velocity_mm_s: Array


START_SIGMA = (0.5, 20.0, 1000.0)
"""Of the given place [mm], velocity [mm/s] and acceleration [mm/s^2], which is given as 0."""


def starts_at(scene: "Scene", exposure: int) -> Starts:
    """Return the true positions and velocities with errors of ``START_SIGMA``."""
    rng = np.random.default_rng(exposure)
    position, velocity = scene.positions_mm[exposure], scene.velocity_mm_s[exposure]
    return Starts(
        position + START_SIGMA[0] * rng.standard_normal(position.shape),
        velocity + START_SIGMA[1] * rng.standard_normal(position.shape),
    )


def ring(sensors: int) -> CameraStack:
    """Sensors on a ring of 800 mm, aimed 1.5 m away, that read 20 degrees off its radius."""
    placed = []
    for index in range(sensors):
        around = 2.0 * pi * index / sensors
        along = around + pi / 9.0
        placed.append(
            place_sensor(
                f"s{index}",
                lens_position_mm=(400.0 * cos(around), 400.0 * sin(around), 0.0),
                aim_mm=(0.0, 0.0, 1500.0),
                measured_direction=(cos(along), sin(along), 0.0),
                principal_distance_mm=36.0,
                pixels=PIXELS,
                pitch_um=12.0,
            ).model
        )
    return CameraStack.of(placed)


def crossing_paths(markers: int, times_s: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """Return positions and velocities (F, N, 3) of pairs that pass each other at 1 to 5 mm.

    Speeds are 50 to 400 mm/s, accelerations up to some m/s^2.
    """
    positions = np.empty((len(times_s), markers, 3))
    velocity = np.empty_like(positions)
    end = float(times_s[-1])
    meeting_s, meeting_mm = 0.0, CENTRE_MM
    for marker in range(markers):
        if marker % 2 == 0:
            meeting_s = end * rng.uniform(0.35, 0.85)
            meeting_mm = CENTRE_MM + rng.uniform(-150.0, 150.0, 3)
        direction = rng.standard_normal(3)
        direction /= np.linalg.norm(direction)
        aside = np.cross(direction, rng.standard_normal(3))
        aside *= rng.uniform(0.5, 2.5) / np.linalg.norm(aside)
        reach, turn = rng.uniform(50.0, 130.0), 2.0 * pi * rng.uniform(0.15, 0.5)
        sway, sway_turn = 15.0 * rng.standard_normal(3), 2.0 * pi * rng.uniform(0.3, 1.0)
        angle = turn * (times_s - meeting_s)[:, None]
        other = sway_turn * (times_s - meeting_s)[:, None]
        positions[:, marker] = (
            meeting_mm + aside + reach * np.sin(angle) * direction + sway * (1.0 - np.cos(other))
        )
        velocity[:, marker] = reach * turn * np.cos(angle) * direction
        velocity[:, marker] += sway * sway_turn * np.sin(other)
    return positions, velocity


def scene_of(markers: int, sensors: int, frames: int, seed: int) -> Scene:
    """Return a scene with noise, losses, false and merged peaks."""
    rng = np.random.default_rng([markers, sensors, seed])
    cameras = ring(sensors)
    times = np.arange(frames) / RATE_HZ
    positions, velocity = crossing_paths(markers, times, rng)
    expected = FALSE_SHARE * markers
    peaks = tuple(_peaks(cameras.project(position), expected, rng) for position in positions)
    return Scene(cameras, times, positions, velocity, peaks, expected / PIXELS)


def _peaks(readings: Array, false_peaks: float, rng: np.random.Generator) -> Array:
    """Return the peaks of S sensors from readings (N, S), shape (S, K)."""
    lines = []
    for line in readings.T:
        seen = np.sort(
            line[(rng.random(len(line)) >= MISSED) & (np.abs(line - PIXELS / 2) < PIXELS / 2)]
        )
        merged: list[float] = []
        for value in seen.tolist():
            if merged and value - merged[-1] < MERGE_PX:
                share = rng.uniform(0.3, 0.7)
                merged[-1] = share * merged[-1] + (1.0 - share) * value
            else:
                merged.append(value)
        found = np.array(merged) + SIGMA_PX * rng.standard_normal(len(merged))
        extra = rng.uniform(0.0, PIXELS - 1.0, rng.poisson(false_peaks))
        lines.append(np.sort(np.concatenate([found, extra])))
    most = max(1, *(len(line) for line in lines))
    peaks = np.full((len(lines), most), np.nan)
    for row, line in zip(peaks, lines, strict=True):
        row[: len(line)] = line
    return peaks
