"""Incremental search: triples of peaks, extended by the gated peaks of further sensors."""

from dataclasses import dataclass
from math import sqrt
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.measurement.measurement_model import MeasurementModel, PredictedMeasurements
from compute.measurement.measurements import Measurements
from compute.reconstruction.correspondence.candidates import (
    FALSE_REJECTION,
    MISFIT_BANDS,
    Choice,
    MisfitDensity,
    Solve,
)
from compute.reconstruction.triangulation import chi2_limit

Array = NDArray[np.float64]

_GATE: Final = sqrt(chi2_limit(1, FALSE_REJECTION))
_SAMPLE: Final = 64
_ROUNDING_PX: Final = 0.01  # what a point that is a little off changes in a reading


@dataclass(frozen=True, eq=False)
class GatedPeaks:
    """Peaks in the gates of points, as ranges of each sensor's free peaks.

    Args:
        first, count: shape (N, S); count is 0 where no peak is, and for the sensors left out.
        free: indices of each sensor's free peaks, ascending.
    """

    first: NDArray[np.intp]
    count: NDArray[np.intp]
    free: tuple[NDArray[np.intp], ...]


def find_gated_peaks(
    model: MeasurementModel,
    peaks: Measurements,
    free: NDArray[np.bool_],
    points_mm: Array,
    covariance_mm2: Array,
    without: tuple[int, ...],
    misfit_density: MisfitDensity,
    true: int,
) -> GatedPeaks:
    """Find the peaks within the gates about the predicted readings.

    Args:
        model: the measurement model.
        peaks: of the frame.
        free: which of them may be used, shape (S, K).
        points_mm: shape (N, 3) [mm]; NaN: no point.
        covariance_mm2: shape (N, 3, 3) [mm^2].
        without: sensors that are left out.
        misfit_density: counts the peaks in and beside the gates.
        true: how many of a sensor's peaks may be where they should.
    """
    predicted = model.predict(points_mm)
    systematic = _systematic_variance(model, predicted, points_mm)
    free_index = tuple(np.flatnonzero(row) for row in free)
    first = np.zeros((len(points_mm), len(peaks)), dtype=np.intp)
    count = np.zeros_like(first)
    for sensor, index in enumerate(free_index):
        if sensor in without or len(index) == 0:
            continue
        position_px = peaks.position_px[sensor, index]
        slope = predicted.jacobian_px_per_mm[:, sensor]
        by_point = np.einsum("ni,nij,nj->n", slope, covariance_mm2, slope)
        variance = by_point + systematic[sensor] + peaks.sigma_px[sensor, index].max() ** 2
        half = _GATE * np.sqrt(variance) + _ROUNDING_PX
        centre = predicted.reading_px[:, sensor]
        there = np.isfinite(centre) & np.isfinite(half)
        centre, half = np.where(there, centre, -1e9), np.where(there, half, 0.0)
        first[:, sensor] = np.searchsorted(position_px, centre - half)
        count[:, sensor] = np.searchsorted(position_px, centre + half, "right") - first[:, sensor]
        hits = [float(count[:, sensor].sum())]
        for band in MISFIT_BANDS[1:]:
            wide = np.searchsorted(position_px, centre + band * half, "right")
            hits.append(float((wide - np.searchsorted(position_px, centre - band * half)).sum()))
        tried = len(index) * float(there.sum())
        misfit_density.add(np.array(hits) - true, 2.0 * _GATE * MISFIT_BANDS * tried)
    return GatedPeaks(first, count, free_index)


def _systematic_variance(
    model: MeasurementModel, predicted: PredictedMeasurements, points_mm: Array
) -> Array:
    """Return the largest variance by the cameras' and the table's own errors, shape (S,) [px^2].

    The cameras' is that of some of the points: it varies slowly.
    """
    variance = np.zeros(len(model))
    if len(points_mm) == 0:
        return variance
    variance += predicted.table_variance_px2.max(axis=0)
    if model.parameter_covariance is not None:
        sample = points_mm[:: max(1, len(points_mm) // _SAMPLE)]
        variance += model.calibration_variance(sample).max(axis=0)
    return variance


def all_triples(free: NDArray[np.bool_], base: tuple[int, int, int]) -> Choice:
    """Return all combinations of three sensors' free peaks, shape (N, S); -1 elsewhere.

    Args:
        free: peaks that may be used, shape (S, K).
        base: the three sensors.
    """
    axes = [np.flatnonzero(free[sensor]) for sensor in base]
    chosen = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    choice = np.full((len(chosen), len(free)), -1)
    choice[:, base] = chosen
    return choice


def complete_triples(
    solve: Solve,
    model: MeasurementModel,
    peaks: Measurements,
    free: NDArray[np.bool_],
    base: tuple[int, int, int],
    min_peaks: int,
    max_combinations: int,
    misfit_density: MisfitDensity,
) -> tuple[Choice, int]:
    """Return combinations that may be markers, each seen by the three sensors ``base``.

    Args:
        solve: reconstructs.
        model: the measurement model.
        peaks: of the frame.
        free: which of them may be used, shape (S, K).
        base: three sensors.
        min_peaks: peaks that a combination has.
        max_combinations: combinations at most.
        misfit_density: counts what lies beside the gates.

    Returns:
        Combinations, shape (N, S), and how many were cut.
    """
    start = all_triples(free, base)
    if len(start) == 0:
        return start, 0
    points = solve(*peaks.readings(start))
    true = int(free.sum(axis=1)[list(base)].min())
    gated = find_gated_peaks(
        model, peaks, free, points.position_mm, points.covariance_mm2, base, misfit_density, true
    )
    hopeful = np.flatnonzero(3 + (gated.count > 0).sum(axis=1) >= min_peaks)
    return extend_with_gated_peaks(start, gated, hopeful, min_peaks, max_combinations)


def extend_with_gated_peaks(
    start: Choice, gated: GatedPeaks, rows: NDArray[np.intp], min_peaks: int, max_combinations: int
) -> tuple[Choice, int]:
    """Extend combinations by every choice of the peaks in their gates.

    At most one sensor whose gate holds a peak is left out: two missing peaks of a marker, with
    other markers' peaks in both places, are rarer than what is weighed.

    Args:
        start: combinations of three peaks, shape (N, S).
        gated: the peaks in the gates of each.
        rows: which of the combinations to extend.
        min_peaks: fewest peaks of a combination.
        max_combinations: most combinations to return.

    Returns:
        Combinations, shape (C, S), and how many were cut.
    """
    sensors = start.shape[1]
    choice = start[rows]
    left_out = np.zeros(len(rows), dtype=np.intp)
    ahead = (gated.count[rows] > 0).sum(axis=1)
    cut = 0
    for sensor in range(sensors):
        if not gated.count[rows, sensor].any():
            continue
        count = gated.count[rows, sensor]
        ahead = ahead - (count > 0)
        # Without this sensor's peak: by having none, or by leaving it out where enough are left.
        without = (count == 0) | (
            (left_out == 0) & ((choice >= 0).sum(axis=1) + ahead >= min_peaks)
        )
        options = count + without
        total = int(options.sum())
        if total > max_combinations:
            keep = np.cumsum(options) <= max_combinations
            cut += total - int(options[keep].sum())
            rows, choice, left_out, ahead = rows[keep], choice[keep], left_out[keep], ahead[keep]
            count, options = count[keep], options[keep]
            total = int(options.sum())
        source = np.repeat(np.arange(len(rows)), options)
        offset = np.arange(total) - np.repeat(np.cumsum(options) - options, options)
        in_range = offset < count[source]
        choice = choice[source]
        at = np.minimum(gated.first[rows[source], sensor] + offset, len(gated.free[sensor]) - 1)
        choice[:, sensor] = np.where(in_range, gated.free[sensor][at], -1)
        left_out = left_out[source] + (~in_range & (count[source] > 0))
        rows, ahead = rows[source], ahead[source]
    enough = (choice >= 0).sum(axis=1) >= min_peaks
    return choice[enough], cut
