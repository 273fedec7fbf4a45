"""Peaks of random markers, some missed, some no marker's, in no order."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.camera.stack import CameraStack
from compute.reconstruction.correspondence.grouping import Correspondence

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PeakScene:
    """Peaks of S sensors: ``owner`` is the marker of each, -1: none, shape (S, K)."""

    places_mm: Array
    position_px: Array
    sigma_px: Array
    owner: NDArray[np.intp]

    def owners(self, found: Correspondence) -> list[int | None]:
        """Return whose all of a group's peaks are; None: not one marker's."""
        rows = np.arange(len(self.owner))
        result: list[int | None] = []
        for choice in found.peaks:
            whose = set(self.owner[rows, choice][choice >= 0].tolist())
            result.append(whose.pop() if len(whose) == 1 and whose != {-1} else None)
        return result


def random_scene(
    cameras: CameraStack,
    markers: int,
    seed: int,
    missed: float = 0.0,
    false: float = 0.0,
    sigma_px: float = 0.05,
) -> PeakScene:
    """Markers in 400 mm about the rig's target; ``false`` is by marker and sensor."""
    rng = np.random.default_rng(seed)
    places = np.array([0.0, 0.0, 1500.0]) + rng.uniform(-200.0, 200.0, (markers, 3))
    readings = cameras.project(places)
    readings += sigma_px * rng.standard_normal(readings.shape)
    there = rng.random(readings.shape) >= missed
    lines = []
    for sensor in range(len(cameras)):
        stray = rng.uniform(600.0, 1450.0, rng.poisson(false * markers))
        place = np.concatenate([readings[there[:, sensor], sensor], stray])
        whose = np.concatenate([np.flatnonzero(there[:, sensor]), np.full(len(stray), -1)])
        order = rng.permutation(len(place))
        lines.append((place[order], whose[order]))
    most = max(1, *(len(place) for place, _ in lines))
    position = np.full((len(cameras), most), np.nan)
    owner = np.full(position.shape, -1)
    for sensor, (place, whose) in enumerate(lines):
        position[sensor, : len(place)] = place
        owner[sensor, : len(place)] = whose
    sigma = np.where(np.isfinite(position), sigma_px, np.nan)
    return PeakScene(places, position, sigma, owner)
