"""group_peaks: grouping of an exposure's peaks to markers, with their ambiguity."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import log, pi
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from compute.measurement.measurement_model import MeasurementModel
from compute.measurement.measurements import Measurements
from compute.reconstruction.correspondence.candidate_set import CandidateSet, Group
from compute.reconstruction.correspondence.candidates import (
    FALSE_REJECTION,
    MAX_EXTENT_MM,
    Choice,
    MatchSettings,
    MisfitDensity,
    Solve,
    UnexplainedPeaks,
    log_volumes,
)
from compute.reconstruction.correspondence.predicted_candidates import PredictedPoints
from compute.reconstruction.point_batch import PointBatch
from compute.reconstruction.triangulation import chi2_limit

Array = NDArray[np.float64]

_STANDARD: Final = MatchSettings()


@dataclass(frozen=True, eq=False)
class Correspondence:
    """Readings grouped to markers.

    Args:
        readings_px: shape (M, S), NaN where a sensor did not see the marker.
        sigma_px: their standard deviations, shape (M, S).
        ambiguous: whether another grouping is likelier than the settings' ``max_error_rate``, or
            the search was cut; shape (M,).
        points: the points of the groups, solved from these readings, M of them.
        peaks: index of each sensor's peak, in the order given, -1: none; shape (M, S).
        predicted: index of the predicted point that it is, -1: none; shape (M,).
        cut: combinations and sets that were not examined because there were too many; where this
            is not 0, the groups that they might have changed are ambiguous.
    """

    readings_px: Array
    sigma_px: Array
    ambiguous: NDArray[np.bool_]
    points: PointBatch
    peaks: NDArray[np.intp]
    predicted: NDArray[np.intp]
    cut: int

    def __len__(self) -> int:
        """Return the number of groups."""
        return len(self.readings_px)


def group_peaks(
    solve: Solve,
    measurements: Measurements,
    *,
    model: MeasurementModel | None = None,
    predicted: PredictedPoints | None = None,
    settings: MatchSettings = _STANDARD,
) -> Correspondence:
    """Group the peaks of S sensors to markers by the consistency of their planes.

    N markers on three sensors make N^3 points, each of which fits exactly; further sensors,
    and predicted points tell the N true ones from the ghosts [2.15]. Combinations
    that meet are found step by step; of those, the set that explains the peaks best is taken,
    each peak used once (twice, if it is merged); every other set that comes near is weighed
    against it. A marker is ambiguous if the sets without it have a larger share than
    ``settings.max_error_rate``, or if as many wrong combinations of the unexplained peaks are to be
    expected by chance, or if not everything could be looked at.

    What fewer than four sensors saw is no candidate without a prediction. Only where
    nothing is left to choose, one peak on each of three or more sensors, is it taken: as
    unambiguous if that is all that there is.

    The result does not depend on the order of the peaks of a line.

    Args:
        solve: takes readings (N, S) and their standard deviations (N, S).
        measurements: the peaks of S sensors; one that is ``shared`` may be two markers'.
        model: the measurement model of the same sensors; None: only small frames can be grouped,
            those with up to ``candidate_set.MAX_UNPREDICTED_COMBINATIONS`` combinations.
        predicted: where markers are expected; needs ``model``.
        settings: the model of peaks and markers, and the bounds.

    Raises:
        InvalidParameter: predicted points without ``model``.
    """
    if predicted is not None and model is None:
        raise InvalidParameter("predicted points need a model, which says where they are seen")
    count = measurements.count
    seeing = int((count > 0).sum())
    if predicted is not None and len(predicted) == 0:
        predicted = None
    if seeing < 3 or (predicted is None and (count.max() == 1 or seeing == 3)):
        return _nothing_to_choose(solve, measurements)
    peaks = measurements.sort()
    small = group_four_sensor_frame(solve, peaks, settings) if predicted is None else None
    if small is not None:
        return _result(*small, peaks)
    candidate_set = CandidateSet(solve, peaks, settings, model)
    if predicted is not None:
        candidate_set.add_predicted(predicted)
    if seeing >= 4:
        candidate_set.add_free()
    candidate_set.finish()
    points = PointBatch.concatenate(candidate_set.group_points)
    return _result(candidate_set.groups, points, peaks, candidate_set.cut)


def _nothing_to_choose(solve: Solve, measurements: Measurements) -> Correspondence:
    """Return the group of single peaks of three or more sensors, if that is all there is."""
    count = measurements.count
    if (count == 1).sum() < 3 or count.max() > 1:
        return _result([], PointBatch.empty(len(measurements)), measurements)
    choice = measurements.single_peaks
    points = solve(*measurements.readings(choice[None]))
    return _result([Group(tuple(choice.tolist()), ambiguous=False)], points, measurements)


def _result(
    unordered: Sequence[Group], points: PointBatch, peaks: Measurements, cut: int = 0
) -> Correspondence:
    """Return groups and their points in the order of the groups' peaks."""
    order = sorted(range(len(unordered)), key=lambda index: unordered[index].choice)
    groups = [unordered[index] for index in order]
    choice = np.array([group.choice for group in groups], np.intp).reshape(-1, len(peaks))
    original = choice
    if peaks.original_index is not None:
        original = np.where(choice < 0, -1, peaks.original_index[np.arange(len(peaks)), choice])
    return Correspondence(
        *peaks.readings(choice),
        np.array([group.ambiguous for group in groups], np.bool_),
        points.rows(np.array(order, np.intp)),
        original,
        np.array([group.predicted for group in groups], np.intp),
        cut,
    )


SENSORS: Final = 4
MAX_COMBINATIONS: Final = 700
"""Combinations of four peaks: five markers make 625."""
_MAX_JOINT_COMBINATIONS: Final = 100
"""Combinations up to which those of three are reconstructed along with them, not on their own."""
_LIMIT: Final = chi2_limit(1, FALSE_REJECTION)
_HALF_LOG_TWO_PI: Final = 0.5 * log(2.0 * pi)


@dataclass(frozen=True, eq=False)
class _Plan:
    """All choices of four peaks for given counts; for few peaks, all choices of three too.

    ``family`` has for each of the ``whole`` fours its own row and those without a sensor each.
    """

    choice: Choice
    fours: int
    family: NDArray[np.intp] | None
    columns: list[tuple[int, ...]]


def group_four_sensor_frame(
    solve: Solve, peaks: Measurements, settings: MatchSettings
) -> tuple[list[Group], PointBatch] | None:
    """Return the groups of a small frame and their points; None where peaks are contested.

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
    chi2 = points.chi2[: plan.fours]
    good = (chi2 <= _LIMIT).nonzero()[0]
    rows = good.tolist()
    used_peaks = {(sensor, peak) for row in rows for sensor, peak in enumerate(plan.columns[row])}
    free_counts = [count - len(rows) for count in counts]
    single = max(free_counts) == 1 and free_counts.count(1) >= 3
    if not rows or len(used_peaks) < SENSORS * len(rows) or single:
        return None
    if not points.used[good].all():
        return None
    volume, compared = log_volumes(_family(solve, peaks, plan, points, good))
    volume = volume.reshape(len(rows), SENSORS + 1)
    sensor = np.arange(SENSORS)
    log_sigma = np.log(peaks.sigma_px[sensor, plan.choice[good]])
    good_chi2 = chi2[good]
    misfit_density = MisfitDensity()
    misfit_density.count(chi2, 1, min(counts))
    unexplained = UnexplainedPeaks(
        peaks, settings, np.array(free_counts, dtype=np.float64), len(rows)
    )
    odds = (
        float(np.log(unexplained.expected).sum())
        - SENSORS * log(settings.detection_probability)
        - log(len(rows))
        + misfit_density.log_ratio()
    )
    # Of a peak's innovation, by what the other three say.
    log_density = volume[:, :1] - volume[:, 1:] - log_sigma - _HALF_LOG_TWO_PI
    foreign = np.exp(0.5 * good_chi2[:, None] - log_density) @ unexplained.density_per_px
    foreign *= 1.0 / settings.detection_probability - 1.0
    score = compared[:: SENSORS + 1] - log_sigma.sum(axis=1) - _HALF_LOG_TWO_PI - 0.5 * good_chi2
    score += log(settings.markers_per_mm3) + SENSORS * settings.log_detected
    if score.min() <= 0.0:
        return None
    error = 1.0 / (1.0 + np.exp(np.minimum(score, 700.0))) + foreign
    error += np.exp(np.minimum(odds + 0.5 * good_chi2, 0.0))
    variance = points.covariance_mm2[good].trace(axis1=1, axis2=2)
    ambiguous = (error > settings.max_error_rate) | (variance > MAX_EXTENT_MM**2)
    groups = [
        Group(plan.columns[row], flag) for row, flag in zip(rows, ambiguous.tolist(), strict=True)
    ]
    return groups, points.rows(good)


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
    detections = (every >= 0).sum(axis=1)
    fours, threes = every[detections == SENSORS], every[detections == SENSORS - 1]
    columns = [tuple(row) for row in fours.tolist()]
    if len(fours) > _MAX_JOINT_COMBINATIONS:
        return _Plan(fours, len(fours), None, columns)
    choice = np.concatenate([fours, threes])
    at = {tuple(row): index for index, row in enumerate(choice.tolist())}
    family = np.array(
        [[at[row], *(at[(*row[:s], -1, *row[s + 1 :])] for s in range(SENSORS))] for row in columns]
    )
    return _Plan(choice, len(fours), family, columns)
