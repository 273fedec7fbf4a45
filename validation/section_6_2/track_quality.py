"""Quality of tracks of several markers: right, wrong, lost, swapped, false."""

from collections.abc import Sequence
from dataclasses import astuple, dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from validation.section_6.spatial_tracks import SpaceTracks
from validation.thesis_tracking.probabilistic_tracker import (
    AssociationSettings,
    ProbabilisticTracker,
)
from validation.thesis_tracking.sensor_track import SensorTrack

Array = NDArray[np.float64]

NEAR_PX: Final = 8.0
"""A track is at a marker if it is this near: four deviations of a line."""
MAX_VELOCITY_PX_S: Final = 400.0
"""v_max of section 6.2.2: the fastest marker has 340 along a sensor."""
MIN_SCANS: Final = 3
"""Scans that must have seen a track before it counts: the model's own "three successive scans"."""


@dataclass(frozen=True)
class TrackQuality:
    """How markers are held.

    Args:
        first: share of markers and scans with the very first track of that marker.
        right: with any track that began at that marker.
        wrong: with a track only that began at another one, or at none.
        lost: with no track.
        exchanged: how often a marker's track became another one, for one marker and sensor.
        false: tracks that are at no marker in most of the scans that saw them, for one sensor.
        false_life: median number of scans in which these were seen.
        false_old: how many of them became old.
    """

    first: float
    right: float
    wrong: float
    lost: float
    exchanged: float
    false: float
    false_life: float
    false_old: float


def thesis_tracks(points_px: Array, settings: AssociationSettings) -> tuple[SensorTrack, ...]:
    """Follow the points (N, K) of one sensor by the probabilistic model of section 6.2.2."""
    tracker = ProbabilisticTracker(settings)
    for scan in points_px:
        tracker.step(scan)
    return tracker.tracks()


def sensor_track_quality(tracks: Sequence[Sequence[SensorTrack]], truth_px: Array) -> TrackQuality:
    """Return how the tracks of all sensors together hold the markers, (N, M, S) [px]."""
    shares, exchanged, lives, olds = [], 0, [], 0
    for sensor, found in enumerate(tracks):
        truth = truth_px[:, :, sensor]
        false = [track for track in found if _false(track, truth)]
        lives += [track.life for track in false]
        olds += sum(track.life >= MIN_SCANS for track in false)
        off = _distances([track for track in found if track.life >= MIN_SCANS], truth)
        shares.append(_shares(off))
        exchanged += _changes(off)
    first, right, wrong, lost = np.mean(shares, axis=0).tolist()
    sensors, markers = len(tracks), truth_px.shape[1]
    return TrackQuality(
        first, right, wrong, lost,
        exchanged / (sensors * markers),
        len(lives) / sensors,
        float(np.median(lives)) if lives else 0.0,
        olds / sensors,
    )  # fmt: skip


def spatial_track_quality(found: SpaceTracks) -> TrackQuality:
    """Return how tracks in space hold the markers."""
    there = found.identity > 0
    began: dict[int, int] = {}
    for row in found.identity.tolist():
        for marker, number in enumerate(row):
            began.setdefault(number, marker)
    own = np.vectorize(lambda number: began[number])(found.identity) == np.arange(
        found.identity.shape[1]
    )
    firsts = [int(column[column > 0][0]) if column.any() else -1 for column in found.identity.T]
    false = found.false_identities - set(found.identity.ravel().tolist())
    return TrackQuality(
        float((found.identity == np.array(firsts)).mean()),
        float((there & own).mean()),
        float((there & ~own).mean()),
        float((~there).mean()),
        found.switches / found.identity.shape[1],
        float(len(false)),
        float(found.false.sum() / len(false)) if false else 0.0,
        float(len(false)),
    )


def mean_track_quality(track_qualities: Sequence[TrackQuality]) -> TrackQuality:
    """Return the means of several scenes' figures."""
    return TrackQuality(*np.mean([astuple(one) for one in track_qualities], axis=0).tolist())


def _false(track: SensorTrack, truth: Array) -> bool:
    scans = track.first_scan + np.flatnonzero(track.seen)
    off = np.abs(truth[scans] - track.position_px[track.seen][:, None]).min(axis=1)
    return bool((off < NEAR_PX).mean() < 0.5)


def _distances(tracks: Sequence[SensorTrack], truth: Array) -> Array:
    """Return each track's distance to each marker, (tracks, N, M); inf where it is not old."""
    off = np.full((len(tracks), *truth.shape), np.inf)
    for row, track in enumerate(tracks):
        scans = np.arange(track.first_scan, track.first_scan + len(track.position_px))
        old = np.cumsum(track.seen) >= MIN_SCANS
        away = np.abs(truth[scans] - track.position_px[:, None])
        off[row, scans[old]] = away[old]
    return off


def _owners(off: Array) -> NDArray[np.int64]:
    """Return the marker at which each track became old, -1: none."""
    owners = np.full(len(off), -1, np.int64)
    for row, away in enumerate(off):
        first = np.flatnonzero(np.isfinite(away[:, 0]))[:1]
        if len(first) and away[first[0]].min() < NEAR_PX:
            owners[row] = int(away[first[0]].argmin())
    return owners


def _shares(off: Array) -> list[float]:
    """Return the shares of markers and scans: first track, right, wrong, lost."""
    near = off < NEAR_PX
    owners = _owners(off)
    markers = np.arange(off.shape[2])
    own = owners[:, None] == markers
    # Tracks come in the order in which they began.
    first = own & (np.cumsum(own, axis=0) == 1)
    right = (near & own[:, None]).any(axis=0)
    held = near.any(axis=0)
    return [
        float((near & first[:, None]).any(axis=0).mean()),
        float(right.mean()),
        float((held & ~right).mean()),
        float((~held).mean()),
    ]


def _changes(off: Array) -> int:
    """Return how often the track at a marker became another one.

    The last one stays the marker's as long as it is near; where markers meet both are.
    """
    changes = 0
    for marker in range(off.shape[2]):
        last = -1
        for away in off[:, :, marker].T:
            if not len(away) or (last >= 0 and away[last] < NEAR_PX):
                continue
            nearest = int(away.argmin())
            if away[nearest] < NEAR_PX:
                changes += last >= 0
                last = nearest
    return changes
