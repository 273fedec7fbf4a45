"""Fast path for small exposures on four sensors in which no peak is contested.

What ``Pool`` does step by step, for the usual case on the live path: with the same result.
"""

from dataclasses import dataclass
from functools import lru_cache
from math import exp, log, pi
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.measurement.measurements import Measurements
from compute.reconstruction.correspondence.ambiguity import ErrorEstimate, log_misfit_density
from compute.reconstruction.correspondence.candidates import (
    MAX_EXTENT_MM,
    Choice,
    MisfitDensity,
    Solve,
    log_volumes,
)
from compute.reconstruction.correspondence.result import Group
from compute.reconstruction.correspondence.settings import FALSE_REJECTION, MatchSettings
from compute.reconstruction.point_batch import PointBatch
from compute.reconstruction.triangulation import chi2_limit

SENSORS: Final = 4
MAX_COMBINATIONS: Final = 700
"""Combinations of four peaks: five markers make 625."""
_MAX_JOINT_COMBINATIONS: Final = 100
"""Combinations up to which those of three are reconstructed along with them, not on their own."""
_LIMIT: Final = chi2_limit(1, FALSE_REJECTION)
_HALF_LOG_TWO_PI: Final = 0.5 * log(2.0 * pi)


@dataclass(frozen=True, eq=False)
class _Plan:
    """Every choice of four peaks, for so many on each sensor; of few, every choice of three too.

    ``family`` has for each of the ``whole`` fours its own row and those without a sensor each.
    """

    choice: Choice
    whole: int
    family: NDArray[np.intp] | None
    columns: list[tuple[int, ...]]


def group_four_sensor_frame(
    solve: Solve, peaks: Measurements, settings: MatchSettings
) -> tuple[list[Group], PointBatch] | None:
    """Return the groups of a small frame and their points; None: there is something to weigh.

    Args:
        solve: reconstructs.
        peaks: of the frame.
        settings: the model.
    """
    counts = tuple(peaks.count.tolist())
    if len(counts) != SENSORS or min(counts) == 0 or peaks.capacity:
        return None
    if counts[0] * counts[1] * counts[2] * counts[3] > MAX_COMBINATIONS:
        return None
    plan = _plan(counts)
    points = solve(*peaks.readings(plan.choice))
    chi2 = points.chi2[: plan.whole]
    good = (chi2 <= _LIMIT).nonzero()[0]
    rows = good.tolist()
    taken = {(sensor, peak) for row in rows for sensor, peak in enumerate(plan.columns[row])}
    left = [count - len(rows) for count in counts]
    single = max(left) == 1 and left.count(1) >= 3
    if not rows or len(taken) < SENSORS * len(rows) or single:
        return None
    if not points.used[good].all():
        return None
    volume, compared = log_volumes(_family(solve, peaks, plan, points, good))
    volume = volume.reshape(len(rows), SENSORS + 1)
    sensor = np.arange(SENSORS)
    log_sigma = np.log(peaks.sigma_px[sensor, plan.choice[good]])
    own = chi2[good]
    misfit_density = MisfitDensity()
    misfit_density.count(chi2, 1, min(counts))
    known = ErrorEstimate(solve, peaks, settings, np.array(left, dtype=np.float64), len(rows))
    ways = float(np.log(known.unexplained).sum())
    odds = (
        ways
        - SENSORS * log(settings.detection_probability)
        - log(len(rows))
        + log_misfit_density(misfit_density)
    )
    # Of a peak's innovation, by what the other three say.
    log_density = volume[:, :1] - volume[:, 1:] - log_sigma - _HALF_LOG_TWO_PI
    foreign = np.exp(0.5 * own[:, None] - log_density) @ known.density
    foreign *= 1.0 / settings.detection_probability - 1.0
    score = compared[:: SENSORS + 1] - log_sigma.sum(axis=1) - _HALF_LOG_TWO_PI - 0.5 * own
    score += log(settings.markers_per_mm3) + SENSORS * settings.log_seen
    if score.min() <= 0.0:
        return None
    spread = points.covariance_mm2[good].trace(axis1=1, axis2=2)
    groups = []
    for row, misfit, foreign_probability, value, far in zip(
        rows, own.tolist(), foreign.tolist(), score.tolist(), spread.tolist(), strict=True
    ):
        doubt = 1.0 / (1.0 + exp(min(value, 700.0))) + foreign_probability
        doubt += exp(min(odds + 0.5 * misfit, 0.0))
        ambiguous = doubt > settings.max_error_rate or far > MAX_EXTENT_MM**2
        groups.append(Group(plan.columns[row], ambiguous))
    return groups, points.take(good)


def _family(
    solve: Solve, peaks: Measurements, plan: _Plan, points: PointBatch, good: NDArray[np.intp]
) -> NDArray[np.float64]:
    """Return the covariances of fours and of them without a sensor each, shape (G 5, 3, 3)."""
    if plan.family is not None:
        return points.covariance_mm2[plan.family[good].ravel()]
    fewer = np.repeat(plan.choice[good], SENSORS, axis=0).reshape(-1, SENSORS, SENSORS)
    fewer[:, np.arange(SENSORS), np.arange(SENSORS)] = -1
    without = solve(*peaks.readings(fewer.reshape(-1, SENSORS))).covariance_mm2
    both = [points.covariance_mm2[good][:, None], without.reshape(-1, SENSORS, 3, 3)]
    return np.concatenate(both, axis=1).reshape(-1, 3, 3)


@lru_cache(maxsize=256)
def _plan(counts: tuple[int, ...]) -> _Plan:
    axes = [np.arange(-1, count) for count in counts]
    every = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, SENSORS)
    seen = (every >= 0).sum(axis=1)
    fours, threes = every[seen == SENSORS], every[seen == SENSORS - 1]
    columns = [tuple(row) for row in fours.tolist()]
    if len(fours) > _MAX_JOINT_COMBINATIONS:
        return _Plan(fours, len(fours), None, columns)
    choice = np.concatenate([fours, threes])
    at = {tuple(row): index for index, row in enumerate(choice.tolist())}
    family = np.array(
        [[at[row], *(at[(*row[:s], -1, *row[s + 1 :])] for s in range(SENSORS))] for row in columns]
    )
    return _Plan(choice, len(fours), family, columns)
