"""Labelled trajectories, one position a frame, for motion-capture formats."""

from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from compute.pose.rigid_body import PoseStatus
from compute.tracking.track_batch import TrackState
from service.api.exports.motion_table import NO_MARKER, MotionTable

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Trajectory:
    """One labelled thing in F frames.

    Args:
        label: what it is; no two have the same.
        position_mm: shape (F, 3) [mm]; NaN: a gap.
        sd_mm: root of the mean variance of the three coordinates, shape (F,) [mm].
    """

    label: str
    position_mm: Array
    sd_mm: Array


def trajectories(
    table: MotionTable, *, predicted: bool = False, points: bool = False
) -> list[Trajectory]:
    """Return the tracks of a table, then the origins and tips of its tools.

    Tracks that were never confirmed are left out: they may be ghosts.

    Args:
        table: what was found.
        predicted: keep positions of tracks at frames in which nothing was seen of them; else
            these are gaps.
        points: in the tracks' place the points of strobed markers, as they were reconstructed.

    Raises:
        InvalidParameter: there is nothing that has a label.
    """
    found = _of_markers(table) if points else _of_tracks(table, predicted)
    found += _of_tools(table)
    if not found:
        raise InvalidParameter(
            "there is nothing with a label: no point of a strobed marker, and no tool"
            if points
            else "there is nothing with a label: no track was confirmed, and there is no tool"
        )
    return found


def _of_tracks(table: MotionTable, predicted: bool) -> list[Trajectory]:
    tracks = table.tracks
    seen = tracks.state == TrackState.CONFIRMED
    kept = seen | (tracks.state == TrackState.COASTING) if predicted else seen
    identities = np.unique(tracks.identity[seen]).tolist()
    markers = {}
    for identity in identities:
        own = tracks.marker[seen & (tracks.identity == identity)]
        markers[identity] = int(own[-1])
    shared = Counter(markers.values())
    found = []
    for identity in identities:
        marker = markers[identity]
        alone = marker != NO_MARKER and shared[marker] == 1
        label = f"marker-{marker}" if alone else f"track-{identity}"
        own = np.flatnonzero(kept & (tracks.identity == identity))
        found.append(
            _placed(table, label, tracks.frame[own], tracks.position_mm[own], tracks.sd_mm[own])
        )
    return found


def _of_markers(table: MotionTable) -> list[Trajectory]:
    points = table.points
    marker = table.marker[points.frame]
    found = []
    for number in np.unique(marker[marker != NO_MARKER]).tolist():
        own = np.flatnonzero(marker == number)
        found.append(
            _placed(
                table,
                f"marker-{number}",
                points.frame[own],
                points.position_mm[own],
                points.sd_mm[own],
            )
        )
    return found


def _of_tools(table: MotionTable) -> list[Trajectory]:
    """Return origins and tips where poses are OK: these formats have no word for another status."""
    found = []
    poses = table.poses
    good = poses.status == PoseStatus.OK.value
    for index, name in enumerate(table.tools):
        own = np.flatnonzero(good & (poses.tool == index))
        frame, origin, tip = poses.frame[own], poses.translation_mm[own], poses.tip_mm[own]
        found.append(_placed(table, f"{name}_origin", frame, origin, poses.sd_mm[own]))
        if not np.array_equal(origin, tip, equal_nan=True):
            found.append(_placed(table, f"{name}_tip", frame, tip, poses.tip_sd_mm[own]))
    return found


def _placed(
    table: MotionTable, label: str, frame: NDArray[np.intp], position_mm: Array, sd_mm: Array
) -> Trajectory:
    whole = Trajectory(label, np.full((len(table), 3), np.nan), np.full(len(table), np.nan))
    whole.position_mm[frame] = position_mm
    whole.sd_mm[frame] = np.sqrt((sd_mm**2).mean(axis=1))
    return whole
