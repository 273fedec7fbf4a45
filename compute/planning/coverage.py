"""Coverage of a working volume by the sensors."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.camera.model import Vector3
from compute.parameter_checks import check_finite, require

Array = NDArray[np.float64]

MAX_GRID_POINTS = 100_000
"""Largest number of grid points."""


@dataclass(frozen=True)
class Box:
    """A working volume: a box along the world's axes.

    Args:
        centre_mm: its centre [mm].
        size_mm: its lengths along X, Y and Z [mm].

    Raises:
        InvalidParameter: a length that is not positive.
    """

    centre_mm: Vector3
    size_mm: Vector3

    def __post_init__(self) -> None:
        valid = all(0.0 < length < np.inf for length in self.size_mm)
        require(valid, "hold three positive lengths", size_mm=self.size_mm)
        check_finite(self, "centre_mm")

    def contains(self, points_mm: Array) -> NDArray[np.bool_]:
        """Return which points (..., 3) lie inside; NaN does not."""
        with np.errstate(invalid="ignore"):
            away = np.abs(points_mm - np.asarray(self.centre_mm))
        inside: NDArray[np.bool_] = (away <= np.asarray(self.size_mm) / 2.0).all(axis=-1)
        return inside

    def uniform(self, count: int, rng: np.random.Generator) -> Array:
        """Return uniformly distributed points in the box, shape (count, 3) [mm].

        Args:
            count: number of points.
            rng: random number generator.
        """
        share = rng.random((count, 3)) - 0.5
        points: Array = np.asarray(self.centre_mm) + share * np.asarray(self.size_mm)
        return points


@dataclass(frozen=True, eq=False)
class Grid:
    """A regular grid of points over a box, its faces included.

    Args:
        points_mm: shape (N, 3) [mm], X changing slowest.
        weights: the share of the volume that each point stands for (trapezoidal rule), shape
            (N,), adding up to 1.
    """

    points_mm: Array
    weights: Array


def volume_grid(box: Box, points: tuple[int, int, int]) -> Grid:
    """Return a regular grid of points over a box.

    Args:
        box: the box.
        points: number along X, Y and Z, each at least 2; odd numbers include the centre.

    Raises:
        InvalidParameter: fewer than 2 along an axis, or more than 100,000 in all.
    """
    require(
        min(points) >= 2 and int(np.prod(points, dtype=np.int64)) <= MAX_GRID_POINTS,
        f"have at least 2 points along each axis and at most {MAX_GRID_POINTS} in all",
        grid=points,
    )
    axes, shares = [], []
    for centre, size, count in zip(box.centre_mm, box.size_mm, points, strict=True):
        axes.append(centre + size * np.linspace(-0.5, 0.5, count))
        share = np.full(count, 1.0 / (count - 1))
        share[[0, -1]] /= 2.0
        shares.append(share)
    points_mm = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    weights = np.einsum("i,j,k->ijk", *shares).ravel()
    return Grid(points_mm, weights)


@dataclass(frozen=True)
class Coverage:
    """Shares of a volume that sensors see.

    Args:
        by_count: share that exactly 0, 1, ... S sensors see.
        by_sensor: share that each sensor sees.
        all_sensors: share that all sensors see.
        three_or_more: share that at least three sensors see, where positions can be determined.
    """

    by_count: tuple[float, ...]
    by_sensor: tuple[float, ...]
    all_sensors: float
    three_or_more: float


def is_visible(position_px: Array, pixels: int, light: Array) -> NDArray[np.bool_]:
    """Return which sensors see which points: the reading lies on the pixels, with light.

    Args:
        position_px: readings, shape (N, S) [px]; NaN where there is none.
        pixels: pixels of a line; it covers -0.5 to pixels - 0.5.
        light: light of each line, in any unit, shape (N, S).
    """
    with np.errstate(invalid="ignore"):
        on_pixels = (position_px >= -0.5) & (position_px <= pixels - 0.5)
        result: NDArray[np.bool_] = on_pixels & (light > 0.0)
    return result


def coverage(visible: NDArray[np.bool_], weights: Array) -> Coverage:
    """Summarise which sensors see which points.

    Args:
        visible: shape (N, S).
        weights: share of the volume that each point represents, shape (N,).
    """
    counts = visible.sum(axis=1)
    sensors = visible.shape[1]
    shares = np.bincount(counts, weights, minlength=sensors + 1)
    return Coverage(
        tuple(shares.tolist()),
        tuple((weights @ visible).tolist()),
        float(shares[sensors]),
        float(shares[3:].sum()),
    )
