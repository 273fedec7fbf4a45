"""Labelled trajectories, one position a frame, for motion-capture formats."""

from collections import Counter
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from compute.pose.rigid_body import PoseStatus
from compute.tracking.track_batch import TrackState
from service.api.exports.motion_table import NO_MARKER, MotionTable, PointRows, PoseRows, TrackRows

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
    # The newest marker of each track is its last, as later items replace earlier ones.
    markers = dict(zip(tracks.identity[seen].tolist(), tracks.marker[seen].tolist(), strict=True))
    shared = Counter(markers.values())
    trajectories = []
    for identity, marker in sorted(markers.items()):
        alone = marker != NO_MARKER and shared[marker] == 1
        label = f"marker-{marker}" if alone else f"track-{identity}"
        trajectories.append(_placed(table, label, tracks, kept & (tracks.identity == identity)))
    return trajectories


def _of_markers(table: MotionTable) -> list[Trajectory]:
    points = table.points
    marker = table.marker[points.frame]
    return [
        _placed(table, f"marker-{number}", points, marker == number)
        for number in np.unique(marker[marker != NO_MARKER]).tolist()
    ]


def _of_tools(table: MotionTable) -> list[Trajectory]:
    """Return origins and tips where poses are OK: these formats have no word for another status."""
    trajectories = []
    poses = table.poses
    tips = replace(poses, translation_mm=poses.tip_mm, sd_mm=poses.tip_sd_mm)
    good = poses.status == PoseStatus.OK.value
    for index, name in enumerate(table.tools):
        chosen = good & (poses.tool == index)
        trajectories.append(_placed(table, f"{name}_origin", poses, chosen))
        if not np.array_equal(poses.translation_mm[chosen], poses.tip_mm[chosen], equal_nan=True):
            trajectories.append(_placed(table, f"{name}_tip", tips, chosen))
    return trajectories


def _placed(
    table: MotionTable,
    label: str,
    rows: PointRows | TrackRows | PoseRows,
    chosen: NDArray[np.bool_],
) -> Trajectory:
    """Return the positions of the chosen rows at their frames, gaps elsewhere."""
    position_mm = rows.translation_mm if isinstance(rows, PoseRows) else rows.position_mm
    whole = Trajectory(label, np.full((len(table), 3), np.nan), np.full(len(table), np.nan))
    frame = rows.frame[chosen]
    whole.position_mm[frame] = position_mm[chosen]
    whole.sd_mm[frame] = np.sqrt((rows.sd_mm[chosen] ** 2).mean(axis=1))
    return whole
