"""Unresolved neighbours: untracked peaks that may merge with a track's peak, and displace it."""

from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.measurement.measurements import Measurements
from compute.tracking.settings import TrackerSettings

Array = NDArray[np.float64]

NEIGHBOUR_FIELDS: Final = 3
"""Distance from the track's own peak [px], its rate [px/s], and the number of its detections."""
_SEARCH_RESOLUTION_FACTOR: Final = 4.0
"""Distance within which neighbours are searched, in ``resolution_px``."""
_MERGE_RESOLUTION_FACTOR: Final = 1.25
"""Distance within which a neighbour counts as merged, in ``resolution_px``."""
_GATE_RESOLUTION_FACTOR: Final = 1.0
"""Gate about a neighbour's predicted distance, in ``resolution_px``."""
_MIN_DETECTIONS: Final = 2
_MAX_DETECTIONS: Final = 100.0


def predict_merged(
    neighbours: Array, step_s: Array, settings: TrackerSettings
) -> NDArray[np.bool_]:
    """Return whether a neighbour is predicted to merge with each track's peak, shape (T, S).

    Args:
        neighbours: at the last exposure, shape (T, S, 3).
        step_s: time since then, shape (T,) [s].
        settings: its ``resolution_px``.
    """
    ahead = neighbours[..., 0] + neighbours[..., 1] * step_s[:, None]
    near = np.abs(ahead) <= _MERGE_RESOLUTION_FACTOR * settings.resolution_px
    hidden: NDArray[np.bool_] = near & (neighbours[..., 2] >= _MIN_DETECTIONS)
    return hidden


def inflate_unresolved(
    peaks: Measurements, reading_px: Array, hidden: NDArray[np.bool_], settings: TrackerSettings
) -> Measurements:
    """Return the peaks, with inflated variance where they may be merged with a neighbour's.

    Args:
        peaks: of the exposure.
        reading_px: where tracks are predicted, shape (T, S).
        hidden: whether a neighbour is predicted to merge there, shape (T, S).
        settings: the merging distance.
    """
    with np.errstate(invalid="ignore"):
        apart = np.abs(peaks.position_px[None] - reading_px[..., None])
    near = (apart <= (_MERGE_RESOLUTION_FACTOR + 1.0) * settings.resolution_px) & peaks.usable
    # Two peaks there: they are not merged.
    alone = near & ((near.sum(axis=2) == 1) & hidden)[..., None]
    merge_variance = settings.resolution_px**2 / 12.0
    variance = peaks.variance_px2 + np.where(alone.any(axis=0), merge_variance, 0.0)
    return replace(peaks, variance_px2=variance)


def any_neighbour(
    track_peaks: NDArray[np.int32],
    peaks: Measurements,
    free: NDArray[np.bool_],
    settings: TrackerSettings,
) -> bool:
    """Return whether a free peak is near the peak of any track.

    Args:
        track_peaks: index of each track's peaks; -1: none, shape (T, S).
        peaks: of the exposure.
        free: untracked peaks, shape (S, K).
        settings: the merging distance.
    """
    sensor, peak = free.nonzero()
    if len(sensor) == 0:
        return False
    there = track_peaks[:, sensor]
    apart = peaks.position_px[sensor, there] - peaks.position_px[sensor, peak]
    near = (
        (np.abs(apart) <= _SEARCH_RESOLUTION_FACTOR * settings.resolution_px)
        & (there >= 0)
        & (there != peak)
    )
    return bool(near.any())


def update_neighbours(
    neighbours: Array,
    track_peaks: NDArray[np.int32],
    peaks: Measurements,
    free: NDArray[np.bool_],
    step_s: Array,
    settings: TrackerSettings,
) -> Array:
    """Return the neighbours of each track's peaks after an exposure, shape (T, S, 3).

    Args:
        neighbours: after the last one, shape (T, S, 3).
        track_peaks: index of each track's peaks; -1: none, shape (T, S).
        peaks: of the exposure.
        free: untracked peaks, shape (S, K).
        step_s: time since the last exposure, shape (T,).
        settings: the merging distance.
    """
    sensor = np.arange(track_peaks.shape[1])
    step = np.maximum(step_s, 1e-9)[:, None]
    ahead = neighbours[..., 0] + neighbours[..., 1] * step
    confirmed = neighbours[..., 2] >= _MIN_DETECTIONS
    there = track_peaks >= 0
    position_px = np.where(there, peaks.position_px[sensor, np.maximum(track_peaks, 0)], np.nan)
    distance = np.where(free, peaks.position_px, np.nan)[None] - position_px[..., None]
    is_track_peak = np.arange(peaks.position_px.shape[1]) == track_peaks[..., None]
    distance = np.where(is_track_peak | ~np.isfinite(distance), np.inf, distance)
    expected = np.where(confirmed, ahead, neighbours[..., 0])
    off = np.abs(distance - np.where(neighbours[..., 2] > 0, expected, 0.0)[..., None])
    best = off.argmin(axis=2)[..., None]
    nearest = np.take_along_axis(distance, best, axis=2)[..., 0]
    off = np.take_along_axis(off, best, axis=2)[..., 0]
    merge = settings.resolution_px
    reach = (
        np.where(
            confirmed,
            _GATE_RESOLUTION_FACTOR,
            np.where(
                neighbours[..., 2] > 0, 0.5 * _SEARCH_RESOLUTION_FACTOR, _SEARCH_RESOLUTION_FACTOR
            ),
        )
        * merge
    )
    found = (off <= reach) & (np.abs(nearest) <= _SEARCH_RESOLUTION_FACTOR * merge)
    with np.errstate(invalid="ignore"):
        rate = (nearest - neighbours[..., 0]) / step
    rate = np.where(confirmed, 0.5 * (rate + neighbours[..., 1]), rate)
    # A hidden neighbour keeps its rate; one that should be detected and is not is deleted.
    hidden = confirmed & (np.abs(ahead) <= _MERGE_RESOLUTION_FACTOR * merge)
    unknown = neighbours[..., 2] == 0
    rate = np.where(found, rate, neighbours[..., 1])
    count = np.minimum(neighbours[..., 2] + found, _MAX_DETECTIONS)
    after = np.stack(
        [np.where(found, nearest, ahead), np.where(unknown, 0.0, rate), count], axis=-1
    )
    after[~found & ~hidden & there] = 0.0
    after[~np.isfinite(after).all(axis=2)] = 0.0
    return after
