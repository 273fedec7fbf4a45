"""Weighted areas above a low threshold, thesis 6.2.1."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from compute.signal.centroid_settings import require_between
from compute.signal.thesis_pipeline.steps import Array, as_scans


@dataclass(frozen=True)
class Area:
    """A run of pixels above a level.

    Args:
        first_px, last_px: its ends; both belong to it.
        maximum: the largest value in it, P_m of [6.5].
        total: the sum of its values [6.4].
    """

    first_px: int
    last_px: int
    maximum: float
    total: float

    @property
    def weight(self) -> float:
        """Maximum times sum [6.5]: noise over many pixels has the sum, not the maximum."""
        return self.maximum * self.total


@dataclass(frozen=True)
class WeightedAreas:
    """Detection of peaks by areas whose weight [6.5] is large.

    A low threshold keeps faint targets and much noise; the weights tell them apart. How large
    a weight is enough the text does not say: here a fraction of the largest on the scan.

    Args:
        level_fraction: the low threshold, as a fraction of the scan's greatest value, 0 to 0.95.
        keep_fraction: minimum weight, as a fraction of the scan's largest weight, 0 to 1.

    Raises:
        InvalidParameter: a value outside its range.
    """

    level_fraction: float = 0.1
    keep_fraction: float = 0.05

    def __post_init__(self) -> None:
        require_between("level_fraction", self.level_fraction, 0.0, 0.95)
        require_between("keep_fraction", self.keep_fraction, 0.0, 1.0)

    def find_areas(self, scan: ArrayLike) -> tuple[Area, ...]:
        """Return all areas of one scan (P,) that has no background, from left to right [6.3]."""
        values = as_scans(scan)
        return areas_above(values, self.level_fraction * max(float(values.max()), 0.0))

    def select_areas(self, scan: ArrayLike) -> tuple[Area, ...]:
        """Return the areas of one scan (P,) that are heavy enough."""
        areas = self.find_areas(scan)
        heaviest = max((area.weight for area in areas), default=0.0)
        return tuple(area for area in areas if area.weight >= self.keep_fraction * heaviest)

    def apply(self, scans: ArrayLike) -> Array:
        """Return scans (..., P) with zero wherever no area is kept."""
        values = as_scans(scans)
        result = np.zeros_like(values)
        rows, out = values.reshape(-1, values.shape[-1]), result.reshape(-1, values.shape[-1])
        for row, target in zip(rows, out, strict=True):
            for area in self.select_areas(row):
                run = slice(area.first_px, area.last_px + 1)
                target[run] = row[run]
        return result


def areas_above(scan: Array, level: float) -> tuple[Area, ...]:
    """Return the runs of pixels above a level, from left to right.

    Args:
        scan: values, shape (P,).
        level: the level, in their unit.
    """
    above = np.concatenate([[False], scan > level, [False]])
    ends = np.flatnonzero(above[1:] != above[:-1])
    return tuple(
        Area(first, stop - 1, float(scan[first:stop].max()), float(scan[first:stop].sum()))
        for first, stop in zip(ends[::2].tolist(), ends[1::2].tolist(), strict=True)
    )
