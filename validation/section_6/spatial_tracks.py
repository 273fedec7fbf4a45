"""Tracks in space, assigned to the true markers."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from compute.camera.model import SensorModel
from compute.camera.stack import CameraStack
from compute.measurement.measurements import Measurements
from compute.signal.peaks import PeakBatch
from compute.tracking.settings import TrackerSettings
from compute.tracking.track_batch import TrackBatch, TrackState
from compute.tracking.tracker import Tracker
from validation.thesis_tracking.settings import ThesisSettings
from validation.thesis_tracking.thesis_tracker import ThesisTracker

Array = NDArray[np.float64]

TrackingSettings = TrackerSettings | ThesisSettings
"""The live tracker on readings, or a method of the thesis's chapter 6."""

NEAR_MM: Final = 30.0
"""A track further than this from a marker is not the marker's."""


@dataclass(frozen=True, eq=False)
class SpaceTracks:
    """What was tracked of M markers over N frames.

    Args:
        identity: of the track that was nearest to each marker, 0: none, int64, (N, M).
        position_mm: its position, (N, M, 3); NaN: none.
        velocity_mm_s, acceleration_mm_s2: likewise.
        false: tracks of no marker in each frame, int64, (N,).
        false_identities: their numbers.
    """

    identity: NDArray[np.int64]
    position_mm: Array
    velocity_mm_s: Array
    acceleration_mm_s2: Array
    false: NDArray[np.int64]
    false_identities: frozenset[int]

    @property
    def switches(self) -> int:
        """How often a marker's track became another one."""
        changes = 0
        for column in self.identity.T:
            known = column[column > 0]
            changes += int((np.diff(known) != 0).sum())
        return changes


def track(
    time_s: Array,
    peaks: Sequence[PeakBatch],
    models: Sequence[SensorModel],
    markers_mm: Array,
    settings: TrackingSettings,
) -> SpaceTracks:
    """Track all frames, and say whose each confirmed track is.

    Args:
        time_s: of the exposures, shape (N,).
        peaks: of each sensor, N lines each.
        models: the cameras.
        markers_mm: where the markers are, shape (N, M, 3).
        settings: of the tracker: ours, or a method of the thesis.
    """
    stack, pixels = CameraStack.of(list(models)), tuple(model.pixels for model in models)
    tracker: Tracker | ThesisTracker
    if isinstance(settings, ThesisSettings):
        tracker = ThesisTracker(stack, settings, pixels=pixels)
    else:
        tracker = Tracker(stack, settings, pixels=pixels)
    room = max(batch.position_px.shape[1] for batch in peaks)
    rows = [
        tracker.step(
            round(float(time) * 1e9),
            Measurements.of(
                _stacked([batch.position_px[frame] for batch in peaks], room),
                _stacked([batch.sigma_px[frame] for batch in peaks], room),
                _stacked([batch.flags[frame] for batch in peaks], room, 0.0).astype(np.int32),
            ),
            None,
        )
        for frame, time in enumerate(time_s)
    ]
    return _assigned(rows, markers_mm)


def _stacked(rows: Sequence[NDArray[np.generic]], room: int, fill: float = np.nan) -> Array:
    table = np.full((len(rows), room), fill)
    for row, values in zip(table, rows, strict=True):
        row[: len(values)] = values
    return table


def _assigned(batches: Sequence[TrackBatch], markers_mm: Array) -> SpaceTracks:
    frames, markers = markers_mm.shape[:2]
    identity = np.zeros((frames, markers), np.int64)
    position, velocity, acceleration = (np.full((frames, markers, 3), np.nan) for _ in range(3))
    false = np.zeros(frames, np.int64)
    numbers: set[int] = set()
    for frame, batch in enumerate(batches):
        known = np.flatnonzero(batch.state != TrackState.TENTATIVE)
        distance = np.linalg.norm(batch.position_mm[known, None] - markers_mm[frame], axis=2)
        rows, columns = linear_sum_assignment(np.minimum(distance, NEAR_MM))
        near = distance[rows, columns] < NEAR_MM
        rows, columns = known[rows[near]], columns[near]
        identity[frame, columns] = batch.identity[rows]
        position[frame, columns] = batch.position_mm[rows]
        velocity[frame, columns] = batch.velocity_mm_s[rows]
        acceleration[frame, columns] = batch.acceleration_mm_s2[rows]
        others = np.setdiff1d(known, rows)
        false[frame] = len(others)
        numbers.update(batch.identity[others].tolist())
    return SpaceTracks(identity, position, velocity, acceleration, false, frozenset(numbers))
