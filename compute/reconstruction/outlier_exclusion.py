"""Exclusion of wrong readings of labelled points: detection, identification, adaptation.

The steps of P. J. G. Teunissen ("Quality control in integrated navigation systems", IEEE AES
Magazine 5(7), 1990, doi:10.1109/62.134219). Detection is the chi-square test of all readings of a
point, which triangulation has made. Identification compares the alternatives, one reading wrong or
two, by the chi-square that each leaves: without reading i it is smaller by ``w_i^2``, the square
of Baarda's normalised residual. Adaptation is the solution without them.

Only for readings that are known to be one marker's: where peaks are still to be grouped, leaving
out the peak that does not fit is how a ghost is made.
"""

from collections.abc import Callable
from itertools import combinations
from math import comb
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.reconstruction.point_batch import PointBatch, PointFlag
from compute.reconstruction.triangulation import INCONSISTENCY_SIGNIFICANCE, chi2_limit
from compute.reliability import ACCEPTANCE_SIGNIFICANCE

Array = NDArray[np.float64]

MAX_EXCLUDED: Final = 2
"""Most readings of a point that are left out."""
IDENTIFICATION_MARGIN: Final = 16.0
"""The next best alternative must leave a chi2 larger by this: it is 3,000 times less likely."""
MAX_ALTERNATIVES: Final = 512
"""More alternatives than this are not examined."""
SUSPICIOUS: Final = PointFlag.INCONSISTENT | PointFlag.NO_CONVERGENCE
"""Flags of the points whose readings are looked at."""


def min_sensors(excluded: int) -> int:
    """Return the minimum number of sensors that identifies ``excluded`` outliers.

    With three unknowns, ``3 + k`` wrong and right readings may agree by chance of the errors; the
    others must be more than the k wrong ones: five for one, seven for two. (With four readings
    every three of them fit exactly: each may be the wrong one.)
    """
    return 3 + 2 * excluded


def exclude_outliers(
    solve: Callable[[Array, Array], PointBatch],
    points: PointBatch,
    readings_px: Array,
    sigma_px: Array,
) -> PointBatch:
    """Exclude outliers where the other readings identify them.

    Points without the flag INCONSISTENT (or NO_CONVERGENCE) are not touched. Of the others, those
    from which a reading or two were left out carry READING_EXCLUDED; where it cannot be said which
    reading is wrong, all stay used, and the point carries NOT_IDENTIFIABLE.

    Args:
        solve: triangulates readings (N, S) with standard deviations (N, S).
        points: what it returned for these readings, N points.
        readings_px: of one marker each, shape (N, S) [px].
        sigma_px: their standard deviations, shape (N, S) or (S,) [px].

    Returns:
        The points; the same object where nothing is wrong.
    """
    open_rows = np.flatnonzero(points.flags & int(SUSPICIOUS))
    if len(open_rows) == 0:
        return points
    result = points.rows(np.arange(len(points)))
    readings = np.asarray(readings_px, dtype=np.float64)
    sigma = np.broadcast_to(sigma_px, readings.shape)
    count = points.used.sum(axis=1)
    for excluded in range(1, MAX_EXCLUDED + 1):
        open_rows = open_rows[
            [
                count[row] >= min_sensors(excluded)
                and comb(count[row], excluded) <= MAX_ALTERNATIVES
                for row in open_rows
            ]
        ]
        if len(open_rows) == 0:
            break
        sensors = [
            np.array(list(combinations(np.flatnonzero(points.used[row]), excluded)))
            for row in open_rows
        ]
        size = [len(one) for one in sensors]
        source = np.repeat(open_rows, size)
        fewer = readings[source]
        fewer[np.arange(len(fewer))[:, None], np.concatenate(sensors)] = np.nan
        trials = solve(fewer, sigma[source])
        end = np.cumsum(size)
        fits = [
            _take_best(result, points, row, trials.part(last - length, last), excluded)
            for row, last, length in zip(open_rows.tolist(), end.tolist(), size, strict=True)
        ]
        open_rows = open_rows[~np.array(fits)]
    result.flags[(result.flags & int(PointFlag.INCONSISTENT)) > 0] |= int(
        PointFlag.NOT_IDENTIFIABLE
    )
    return result


def _take_best(
    result: PointBatch, points: PointBatch, row: int, trials: PointBatch, excluded: int
) -> bool:
    """Replace a point by the best of its alternatives, if it is clear which that is.

    Args:
        result: the points; the row is replaced.
        points: the points of all readings.
        row: which point.
        trials: the alternatives, each without other readings.
        excluded: number of readings that each leaves out.

    Returns:
        Whether the best alternative fits: then no more readings need to be left out.
    """
    chi2 = np.where(np.isfinite(trials.chi2), trials.chi2, np.inf)
    best, second = np.partition(chi2, 1)[:2]
    dof = int(points.used[row].sum()) - excluded - 3
    if not best <= chi2_limit(dof, ACCEPTANCE_SIGNIFICANCE):
        return False
    # Of so many alternatives the best one lowers chi2 by chance (Bonferroni).
    lowered = chi2_limit(excluded, INCONSISTENCY_SIGNIFICANCE / len(trials))
    if second - best >= IDENTIFICATION_MARGIN and not points.chi2[row] - best < lowered:
        result.put(np.array([row]), trials.rows(np.array([chi2.argmin()])))
        result.flags[row] |= int(PointFlag.READING_EXCLUDED)
    return True
