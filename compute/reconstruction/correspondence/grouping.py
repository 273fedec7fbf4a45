"""group_peaks: grouping of an exposure's peaks to markers, with their ambiguity."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from compute.measurement.measurement_model import MeasurementModel
from compute.measurement.measurements import Measurements
from compute.reconstruction.correspondence.candidate_set import CandidateSet
from compute.reconstruction.correspondence.candidates import Solve
from compute.reconstruction.correspondence.four_sensor_fast_path import group_four_sensor_frame
from compute.reconstruction.correspondence.predicted_candidates import PredictedPoints
from compute.reconstruction.correspondence.result import Correspondence, Group
from compute.reconstruction.correspondence.settings import MatchSettings
from compute.reconstruction.point_batch import PointBatch

Array = NDArray[np.float64]

_STANDARD: Final = MatchSettings()


def group_peaks(
    solve: Solve,
    measurements: Measurements,
    *,
    model: MeasurementModel | None = None,
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
        measurements: the peaks of S sensors; one that is ``shared`` may be two markers'.
        model: the measurement model of the same sensors; None: only small frames can be grouped,
            those with up to ``candidate_set.MAX_UNPREDICTED_COMBINATIONS`` combinations.
        predicted: where markers are expected; needs ``model``.
        bodies_mm: markers of rigid bodies in their own coordinates, (M, 3) each [mm].
        settings: the model of peaks and markers, and the bounds.

    Raises:
        InvalidParameter: predicted points without ``model``, or a body of too few markers.
    """
    if predicted is not None and model is None:
        raise InvalidParameter("predicted points need a model, which says where they are seen")
    outside = (predicted is not None and len(predicted) > 0) or len(bodies_mm) > 0
    count = measurements.count
    seeing = int((count > 0).sum())
    if seeing < 3 or (not outside and (count.max() == 1 or seeing == 3)):
        return _nothing_to_choose(solve, measurements)
    peaks = measurements.sort()
    small = None if outside else group_four_sensor_frame(solve, peaks, settings)
    if small is not None:
        return _result(*small, peaks, 0)
    candidate_set = CandidateSet(solve, peaks, settings, model)
    if predicted is not None and len(predicted) > 0:
        candidate_set.add_predicted(predicted)
    if seeing >= 4:
        candidate_set.add_free()
    for index, body in enumerate(bodies_mm):
        candidate_set.add_body(index, np.asarray(body, dtype=np.float64))
    candidate_set.finish()
    groups = candidate_set.groups
    points = PointBatch.concatenate([PointBatch.empty(len(peaks)), *candidate_set.group_points])
    return _result(groups, points, peaks, candidate_set.cut)


def _nothing_to_choose(solve: Solve, measurements: Measurements) -> Correspondence:
    """Return the group of single peaks of three or more sensors, if that is all there is."""
    count = measurements.count
    sensors = len(measurements)
    if (count == 1).sum() < 3 or count.max() > 1:
        return _no_groups(sensors)
    choice = np.where(count == 1, measurements.usable.argmax(axis=1), -1)[None]
    readings, sigma = measurements.readings(choice)
    return Correspondence(
        readings,
        sigma,
        np.zeros(1, dtype=np.bool_),
        solve(readings, sigma),
        choice,
        np.full(1, -1),
        np.full(1, -1),
        np.full(1, -1),
        0,
    )


def _no_groups(sensors: int, cut: int = 0) -> Correspondence:
    empty, none = np.empty((0, sensors)), np.empty(0, dtype=np.intp)
    return Correspondence(
        empty,
        empty,
        np.zeros(0, dtype=np.bool_),
        PointBatch.empty(sensors),
        np.empty((0, sensors), dtype=np.intp),
        none,
        none,
        none,
        cut,
    )


def _result(
    found: Sequence[Group], points: PointBatch, peaks: Measurements, cut: int
) -> Correspondence:
    """Return groups and their points in the order of the groups' peaks."""
    if not found:
        return _no_groups(len(peaks), cut)
    order = sorted(range(len(found)), key=lambda index: found[index].choice)
    groups = [found[index] for index in order]
    choice = np.array([group.choice for group in groups])
    readings, sigma = peaks.readings(choice)
    assert peaks.original_index is not None
    original_index = np.where(choice < 0, -1, peaks.original_index[np.arange(len(peaks)), choice])
    return Correspondence(
        readings,
        sigma,
        np.array([group.ambiguous for group in groups]),
        points.take(np.array(order)),
        original_index,
        np.array([group.predicted for group in groups]),
        np.array([group.body for group in groups]),
        np.array([group.body_marker for group in groups]),
        cut,
    )
