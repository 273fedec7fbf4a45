"""Moving markers and what sensors make of them, for tests of the tracker: a truth, and its peaks."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.camera.stack import CameraStack

Array = NDArray[np.float64]

PIXELS = 2048
MIDDLE_MM = np.array([0.0, 0.0, 1500.0])


@dataclass(frozen=True)
class Sensing:
    """What sensors add: noise, losses, false peaks, and peaks too near to be told apart."""

    sigma_px: float = 0.05
    missed: float = 0.0
    false_peaks: float = 0.0
    """Expected number a sensor and exposure."""
    merge_px: float = 0.0


def smooth_paths(markers: int, times_s: Array, rng: np.random.Generator) -> Array:
    """Sums of slow sines around the middle, shape (F, N, 3)."""
    amplitude = rng.uniform(20.0, 60.0, (2, markers, 3))
    frequency = rng.uniform(0.2, 0.8, (2, markers, 3))
    phase = rng.uniform(0.0, 2.0 * np.pi, (2, markers, 3))
    centre = MIDDLE_MM + rng.uniform(-100.0, 100.0, (markers, 3))
    angle = 2.0 * np.pi * frequency * times_s[:, None, None, None] + phase
    path: Array = centre + (amplitude * np.sin(angle)).sum(axis=1)
    return path


def peaks_of(
    cameras: CameraStack,
    places_mm: Array,
    sensing: Sensing,
    rng: np.random.Generator,
    room: int | None = None,
) -> tuple[Array, Array, NDArray[np.int32], NDArray[np.int32]]:
    """Return positions, deviations, flags and the marker of each peak (-1: false), each (S, K).

    Places are (N, 3), NaN for a marker that is dark or hidden. A merged peak has the number of
    the marker with the larger share.
    """
    sensors = len(cameras)
    readings = cameras.project(places_mm)
    rows: list[list[tuple[float, int]]] = []
    for sensor in range(sensors):
        seen = [
            (float(value), marker)
            for marker, value in enumerate(readings[:, sensor])
            if np.isfinite(value)
            and -0.5 <= value <= PIXELS - 0.5
            and rng.random() >= sensing.missed
        ]
        seen.sort()
        merged: list[tuple[float, int]] = []
        for value, marker in seen:
            if merged and value - merged[-1][0] < sensing.merge_px:
                share = rng.uniform(0.3, 0.7)
                last = merged.pop()
                value, marker = (
                    share * last[0] + (1.0 - share) * value,
                    last[1] if share > 0.5 else marker,
                )
            merged.append((value, marker))
        found = [(value + sensing.sigma_px * rng.standard_normal(), m) for value, m in merged]
        found += [
            (rng.uniform(0.0, PIXELS - 1.0), -1)
            for _ in range(rng.poisson(sensing.false_peaks))
        ]
        rows.append(sorted(found))
    most = max(1, *(len(row) for row in rows)) if room is None else room
    position = np.full((sensors, most), np.nan)
    owner = np.full((sensors, most), -1, dtype=np.int32)
    for sensor, row in enumerate(rows):
        for index, (value, marker) in enumerate(row):
            position[sensor, index], owner[sensor, index] = value, marker
    sigma = np.where(np.isfinite(position), sensing.sigma_px, np.nan)
    return position, sigma, np.zeros(position.shape, dtype=np.int32), owner
