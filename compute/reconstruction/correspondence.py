"""Which peaks of the sensors belong to one marker, when several are seen at once."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.camera.stack import CameraStack
from compute.mapping.table import CorrectionTable
from compute.reconstruction.estimate import PointBatch
from compute.reconstruction.points import chi2_limit, reconstruct

Array = NDArray[np.float64]
Solve = Callable[[Array, Array], PointBatch]

MAX_CANDIDATES = 2_500
"""Combinations of peaks that are tried; 7 markers on 4 sensors make 2,401."""
FALSE_REJECTION = 1e-6
"""Chance that the peaks of one marker are not taken together."""
CHANCE_GROUPS = 0.01
"""Expected number of unexplained combinations that fit by chance, beyond which there is doubt."""
CHANCE_BAND = 400.0
"""Combinations with chi2 of up to this times the limit tell how many fit by chance."""


@dataclass(frozen=True, eq=False)
class Correspondence:
    """Readings grouped to markers.

    Args:
        readings_px: shape (M, S), NaN where a sensor did not see the marker.
        sigma_px: their standard deviations, shape (M, S).
        ambiguous: whether another grouping fits as well within the noise, shape (M,).
    """

    readings_px: Array
    sigma_px: Array
    ambiguous: NDArray[np.bool_]


def match_peaks(
    cameras: CameraStack,
    position_px: Array,
    sigma_px: Array,
    parameter_covariance: Array | None = None,
    corrections: CorrectionTable | None = None,
) -> Correspondence:
    """Group the peaks of S sensors to markers by the consistency of four or more planes.

    N markers on three sensors make N^3 points, each of which fits exactly; the fourth sensor
    tells the N true ones from the ghosts. Every combination of one peak from each sensor that
    saw anything is tried; the consistent ones are taken by increasing chi2, each peak once. A
    marker whose peaks could also be shared with another consistent combination is marked as
    ambiguous. So are all when so many peaks are left over, because sensors missed markers, that
    some combination of them may fit by chance. With three sensors, or peaks left over, only a
    single peak on each is grouped.

    Args:
        cameras: S calibrated cameras.
        position_px: peaks of each sensor, shape (S, K); NaN where there are fewer than K.
        sigma_px: their standard deviations, shape (S, K).
        parameter_covariance: as in ``reconstruct``.
        corrections: as in ``reconstruct``.
    """

    def solve(readings_px: Array, sigma_px: Array) -> PointBatch:
        return reconstruct(cameras, readings_px, sigma_px, parameter_covariance, corrections)

    return group_peaks(solve, position_px, sigma_px)


def group_peaks(solve: Solve, position_px: Array, sigma_px: Array) -> Correspondence:
    """Group peaks as ``match_peaks`` does, with whatever makes points of readings.

    Args:
        solve: takes readings (N, S) and their standard deviations (N, S).
        position_px: as in ``match_peaks``.
        sigma_px: as in ``match_peaks``.
    """
    sensors = len(position_px)
    counts = np.isfinite(position_px).sum(axis=1)
    free = np.isfinite(position_px)
    groups: list[tuple[Array, Array, bool]] = []
    seeing = np.flatnonzero(counts > 0)
    combinations = int(np.prod(counts[seeing], dtype=np.int64)) if len(seeing) >= 3 else 0
    if len(seeing) >= 4 and 1 < combinations <= MAX_CANDIDATES:
        groups = _consistent(solve, position_px, sigma_px, seeing, free)
    left = free.sum(axis=1)
    if (left == 1).sum() >= 3 and left.max() == 1:
        # One peak on each sensor: nothing to choose, three of them do.
        column = free.argmax(axis=1)
        row = np.arange(sensors)
        reading = np.where(left == 1, position_px[row, column], np.nan)
        sigma = np.where(left == 1, sigma_px[row, column], np.nan)
        groups.append((reading, sigma, bool(combinations > 1 and (left == 1).sum() < 4)))
    if not groups:
        empty = np.empty((0, sensors))
        return Correspondence(empty, empty, np.zeros(0, dtype=np.bool_))
    readings, sigmas, ambiguous = zip(*groups, strict=True)
    return Correspondence(np.array(readings), np.array(sigmas), np.array(ambiguous))


def _consistent(
    solve: Solve,
    position_px: Array,
    sigma_px: Array,
    seeing: NDArray[np.intp],
    free: NDArray[np.bool_],
) -> list[tuple[Array, Array, bool]]:
    """Return the consistent groups, best first; marks their peaks as no longer free."""
    axes = [np.flatnonzero(free[sensor]) for sensor in seeing]
    choice = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(seeing))
    readings = np.full((len(choice), len(position_px)), np.nan)
    sigmas = np.full_like(readings, np.nan)
    readings[:, seeing] = position_px[seeing, choice]
    sigmas[:, seeing] = sigma_px[seeing, choice]
    points = solve(readings, sigmas)
    freedom = len(seeing) - 3
    limit = chi2_limit(freedom, FALSE_REJECTION)
    chi2 = np.where(np.isfinite(points.chi2), points.chi2, np.inf)
    good = np.flatnonzero(chi2 <= limit)
    order = good[np.argsort(chi2[good], kind="stable")]
    groups = []
    for index in order:
        if not free[seeing, choice[index]].all():
            continue
        shares = (choice[good] == choice[index]).any(axis=1)
        free[seeing, choice[index]] = False
        groups.append((readings[index], sigmas[index], bool(shares.sum() > 1)))
    # Misfits of wrong combinations are spread evenly over a range much wider than the noise: how
    # many lie in a wide band around zero tells how many lie within the limit.
    band = np.count_nonzero((chi2 > limit) & (chi2 <= CHANCE_BAND * limit))
    by_chance = band / (CHANCE_BAND ** (freedom / 2) - 1.0)
    # A wrong group is one of the combinations of peaks that no other group explains.
    unexplained = float(np.prod(free[seeing].sum(axis=1) + 1.0))
    if by_chance / len(choice) * unexplained > CHANCE_GROUPS:
        groups = [(reading, sigma, True) for reading, sigma, _ in groups]
    return groups
