"""Captures a tool's geometry from the points of a running device while the tool is held still."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from compute.pose.rigid_body import RigidBody
from compute.pose.tool_calibration.digitising import (
    StationaryPoint,
    StationarySettings,
    average_stationary_tip,
)
from compute.quality.accuracy import MarkerTrack
from service.api.quality.point_tap import PointTap, check_strobed
from service.api.tools.schema import NewCapturedTool, Origin
from service.pipeline.interface import Pipeline
from service.pipeline.tap_collection import collect
from service.problems.errors import NoObservation

Array = NDArray[np.float64]

MIN_FRAMES: Final = 10
MIN_OBSERVED_FRACTION: Final = 0.2
"""A marker must be seen in at least this share of the frames that the best seen one is seen in."""


def capture_geometry(live: Pipeline, asked: NewCapturedTool) -> tuple[RigidBody, Origin]:
    """Look at a tool for as long as was asked; return its geometry, and how it is known.

    The origin is the middle of the markers, the axes are their principal axes: X along the
    longest extent, Z along the shortest.

    Raises:
        DeviceNotRunning: the device does not run, or ends meanwhile.
        NoActiveCalibration: there are no points without one.
        CalibrationSwitched: another one came into force meanwhile.
        NoObservation: a marker was hardly seen.
        NotStationary: the tool moved.
        InvalidParameter: it is not said which markers are the tool's, or the device has not got
            them.
    """
    session = live.session(asked.device_id)
    strobed, together = _wanted(asked, session.description.markers)
    tap = PointTap(strobed, together)
    collect(live, session, tap, asked.duration_s, tap.ended)
    during = "the tool was captured; capture it again"
    calibration_id, table_id = tap.calibration_used(asked.device_id, during)
    tracks = tap.tracks() if strobed is not None else in_canonical_order(tap.tracks())
    _check_seen(tracks, strobed, asked.duration_s)
    still = [
        stationary_marker(
            np.round(track.time_s * 1e9).astype(np.int64), track.position_mm, track.covariance_mm2
        )
        for track in tracks
    ]
    markers = principal_axes(np.array([one.position_mm for one in still]))
    return (
        RigidBody(asked.id, markers, strobed, asked.tip_mm),
        Origin(
            kind="captured",
            frames=min(one.poses for one in still),
            sigma_mm=[float(np.sqrt(np.trace(one.covariance_mm2))) for one in still],
            calibration_id=calibration_id,
            table_id=table_id,
        ),
    )


def _wanted(asked: NewCapturedTool, strobes: int) -> tuple[tuple[int, ...] | None, int]:
    """Return the strobed markers, if so, and how many markers there are."""
    if (asked.strobe_markers is None) == (asked.markers is None):
        raise InvalidParameter(
            "give strobe_markers, the numbers of the tool's strobed markers, or markers, how many "
            "there are in view that are lit together; not both"
        )
    if asked.strobe_markers is None:
        assert asked.markers is not None
        if strobes:
            raise InvalidParameter(
                f'device "{asked.device_id}" strobes {strobes} markers; give the tool\'s as '
                f"strobe_markers, numbers 0 to {strobes - 1}"
            )
        return None, asked.markers
    check_strobed(asked.device_id, asked.strobe_markers, strobes)
    return tuple(asked.strobe_markers), len(asked.strobe_markers)


def _check_seen(tracks: list[MarkerTrack], strobed: tuple[int, ...] | None, seconds: float) -> None:
    counts = [len(track.time_s) for track in tracks]
    least = max(MIN_FRAMES, int(np.ceil(MIN_OBSERVED_FRACTION * max(counts))))
    if min(counts) >= least:
        return
    if strobed is None:
        raise NoObservation(
            f"{min(counts)} frames of {seconds:g} s showed {len(tracks)} markers, no fewer and no "
            f"more; at least {least} are needed: only the tool in view, all of its markers seen",
            frames=min(counts),
        )
    listed = ", ".join(f"{number}: {count}" for number, count in zip(strobed, counts, strict=True))
    raise NoObservation(
        f"in {seconds:g} s the markers were seen in so many frames: {listed}; each must be in at "
        f"least {least}",
        frames=min(counts),
    )


def in_canonical_order(tracks: list[MarkerTrack]) -> list[MarkerTrack]:
    """Return tracks of markers at rest, each of one marker; frames that do not fit are left out.

    Points of markers that are lit together come in any order, another in each frame.
    """
    if not tracks or not len(tracks[0].time_s):
        return tracks
    position = np.stack([track.position_mm for track in tracks], axis=1)  # frame, point, axis
    covariance = np.stack([track.covariance_mm2 for track in tracks], axis=1)
    apart = np.linalg.norm(position[:, :, None] - position[0], axis=3)
    nearest = apart.argmin(axis=1)  # of each frame: the point that is each marker of the first
    whole = (np.sort(nearest, axis=1) == np.arange(len(tracks))).all(axis=1)
    row = np.flatnonzero(whole)[:, None]
    position, covariance = position[row, nearest[whole]], covariance[row, nearest[whole]]
    times = tracks[0].time_s[whole]
    return [
        MarkerTrack(times, position[:, marker], covariance[:, marker])
        for marker in range(len(tracks))
    ]


def stationary_marker(
    times_ns: NDArray[np.int64], positions_mm: Array, covariances_mm2: Array
) -> StationaryPoint:
    """Return the mean of a marker that was held still for as long as a client asked.

    A marker that is hidden for a moment is seen often enough.

    Args:
        times_ns: of N exposures [ns].
        positions_mm: shape (N, 3) [mm].
        covariances_mm2: shape (N, 3, 3) [mm^2].

    Raises:
        NotStationary: it moved.
    """
    span_s = max(float(times_ns[-1] - times_ns[0]) * 1e-9, 1e-9)
    wanted = StationarySettings(seconds=1e-9, min_poses=MIN_FRAMES, max_gap_s=2.0 * span_s)
    return average_stationary_tip(times_ns, positions_mm, covariances_mm2, wanted)


def principal_axes(points_mm: Array) -> Array:
    """Return points (M, 3) about their middle along their principal axes, right-handed [mm].

    The farthest point along X, and along Y, has the positive coordinate: the same tool seen from
    elsewhere gets the same coordinates.
    """
    centred = points_mm - points_mm.mean(axis=0)
    _, _, axes = np.linalg.svd(centred)
    for number in (0, 1):
        along = centred @ axes[number]
        if along[np.abs(along).argmax()] < 0.0:
            axes[number] *= -1.0
    axes[2] = np.cross(axes[0], axes[1])
    found: Array = centred @ axes.T
    return found
