"""Grouping of peaks to markers: candidates, the likeliest set of them, and what is in doubt."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from compute.reconstruction.correspondence.candidate_set import CandidateSet
from compute.reconstruction.correspondence.candidates import Solve
from compute.reconstruction.correspondence.four_sensor_fast_path import group_four_sensor_frame
from compute.reconstruction.correspondence.predicted_candidates import PredictedPoints
from compute.reconstruction.correspondence.predictor import Predictor
from compute.reconstruction.correspondence.result import Correspondence, Group
from compute.reconstruction.correspondence.settings import MatchSettings
from compute.reconstruction.correspondence.sorted_peaks import SortedPeaks

Array = NDArray[np.float64]

_STANDARD: Final = MatchSettings()


def group_peaks(
    solve: Solve,
    position_px: Array,
    sigma_px: Array,
    *,
    predict: Predictor | None = None,
    merged: NDArray[np.bool_] | None = None,
    predicted: PredictedPoints | None = None,
    bodies_mm: Sequence[Array] = (),
    settings: MatchSettings = _STANDARD,
) -> Correspondence:
    """Group the peaks of S sensors to markers by the consistency of their planes.

    N markers on three sensors make N^3 points, each of which fits exactly; further sensors,
    predicted points and rigid bodies tell the N true ones from the ghosts [2.15]. Combinations
    that meet are found step by step; of those, the set that explains the peaks best is taken,
    each peak used once (twice, if it is merged); every other set that comes near is weighed
    against it. A marker is ambiguous if the sets without it have a larger share than
    ``settings.max_error_rate``, or if as many wrong combinations of the unexplained peaks are to be
    expected by chance, or if not everything could be looked at.

    What fewer than four sensors saw is no candidate without a prediction or a body. Only where
    nothing is left to choose, one peak on each of three or more sensors, is it taken: as
    unambiguous if that is all that there is.

    The result does not depend on the order of the peaks of a line.

    Args:
        solve: takes readings (N, S) and their standard deviations (N, S).
        position_px: peaks of each sensor, shape (S, K); NaN where there are fewer than K.
        sigma_px: their standard deviations, shape (S, K).
        predict: the same sensors, forward; None: only small frames can be grouped, those with
            up to ``pool.MAX_UNPREDICTED_COMBINATIONS`` combinations.
        merged: peaks that may be two markers' (``PeakFlag.MERGED``), shape (S, K).
        predicted: where markers are expected; needs ``predict``.
        bodies_mm: markers of rigid bodies in their own coordinates, (M, 3) each [mm].
        settings: the model of peaks and markers, and the bounds.

    Raises:
        InvalidParameter: predicted points without ``predict``, or a body of too few markers.
    """
    if predicted is not None and predict is None:
        raise InvalidParameter("predicted points need predict, which says where they are seen")
    outside = (predicted is not None and len(predicted) > 0) or len(bodies_mm) > 0
    count = (np.isfinite(position_px) & np.isfinite(sigma_px)).sum(axis=1)
    seeing = int((count > 0).sum())
    if seeing < 3 or (not outside and (count.max() == 1 or seeing == 3)):
        return _nothing_to_choose(position_px, sigma_px, count)
    peaks = SortedPeaks.of(position_px, sigma_px, merged, settings.merged_sigma_px)
    groups = None if outside else group_four_sensor_frame(solve, peaks, settings)
    if groups is not None:
        return _result(groups, peaks, 0)
    candidate_set = CandidateSet(solve, peaks, settings, predict)
    if predicted is not None and len(predicted) > 0:
        candidate_set.add_predicted(predicted)
    if seeing >= 4:
        candidate_set.add_free()
    for index, body in enumerate(bodies_mm):
        candidate_set.add_body(index, np.asarray(body, dtype=np.float64))
    candidate_set.finish()
    return _result(candidate_set.groups, peaks, candidate_set.cut)


def _nothing_to_choose(
    position_px: Array, sigma_px: Array, count: NDArray[np.intp]
) -> Correspondence:
    """Return the group of single peaks of three or more sensors, if that is all there is."""
    sensors = len(position_px)
    if (count == 1).sum() < 3 or count.max() > 1:
        return _correspondence(sensors)
    usable = np.isfinite(position_px) & np.isfinite(sigma_px)
    column = usable.argmax(axis=1)
    row = np.arange(sensors)
    there = count == 1
    return Correspondence(
        np.where(there, position_px[row, column], np.nan)[None],
        np.where(there, sigma_px[row, column], np.nan)[None],
        np.zeros(1, dtype=np.bool_),
        np.where(there, column, -1)[None],
        np.full(1, -1),
        np.full(1, -1),
        np.full(1, -1),
        0,
    )


def _correspondence(sensors: int, cut: int = 0) -> Correspondence:
    empty, none = np.empty((0, sensors)), np.empty(0, dtype=np.intp)
    return Correspondence(
        empty,
        empty,
        np.zeros(0, dtype=np.bool_),
        np.empty((0, sensors), dtype=np.intp),
        none,
        none,
        none,
        cut,
    )


def _result(found: Sequence[Group], peaks: SortedPeaks, cut: int) -> Correspondence:
    groups = sorted(found, key=lambda group: group.choice)
    if not groups:
        return _correspondence(len(peaks), cut)
    choice = np.array([group.choice for group in groups])
    readings, sigma = peaks.readings(choice)
    original_index = np.where(choice < 0, -1, peaks.original_index[np.arange(len(peaks)), choice])
    return Correspondence(
        readings,
        sigma,
        np.array([group.ambiguous for group in groups]),
        original_index,
        np.array([group.predicted for group in groups]),
        np.array([group.body for group in groups]),
        np.array([group.body_marker for group in groups]),
        cut,
    )
