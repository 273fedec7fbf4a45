"""Observers of beam holds: pose of the watched tool or positions of watched markers in a frame."""

from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from compute.pose.transform import Transform
from compute.reconstruction.point_batch import PointFlag
from compute.tracking.track_batch import TrackFlag, TrackState
from service.pipeline.beam_hold_spec import WatchedLitMarkers, WatchedStrobedMarkers, WatchedTool
from service.pipeline.frame_batch import FrameBatch

Array = NDArray[np.float64]

UNUSABLE_POINT: Final = PointFlag.INCONSISTENT | PointFlag.AMBIGUOUS | PointFlag.OUTSIDE_MAP
UNUSABLE_TRACK: Final = TrackFlag.AMBIGUOUS | TrackFlag.OUTSIDE_MAP
MAX_AGE_CYCLES: Final = 2
"""A position is too old after this many times the interval between its last two strobe cycles."""


@dataclass(frozen=True, eq=False)
class HoldObservation:
    """What one frame shows of the target of a hold.

    Args:
        pose: T_world_tool; None: not known, or predicted only.
        positions_mm: of markers, shape (M, 3) [mm], NaN where one is not seen; None: none is.
        covariances_mm2: of these, shape (M, 3, 3) [mm^2].
        why: why nothing, or not all, is known; None: all is.
        times_ns: when each marker was seen, on the device's clock, shape (M,) [ns]; None: in this
            frame.
    """

    pose: Transform | None = None
    positions_mm: Array | None = None
    covariances_mm2: Array | None = None
    why: str | None = None
    times_ns: NDArray[np.int64] | None = None


class HoldObserver(Protocol):
    """Finds the target of one hold in frames."""

    def of(self, batch: FrameBatch, index: int) -> HoldObservation:
        """Return the observation of the frame with this index."""
        ...


class ToolObserver:
    """The pose of a tool, in frames that measured it."""

    def __init__(self, spec: WatchedTool) -> None:
        self._tool = spec.tool

    def of(self, batch: FrameBatch, index: int) -> HoldObservation:
        """Return the observation of the frame with this index."""
        poses = () if batch.motion is None else batch.motion.poses_of(index)
        pose = next((one for one in poses if one.tool == self._tool), None)
        if pose is None:
            return HoldObservation(why=f'tool "{self._tool}" is not tracked')
        if not pose.valid:
            return HoldObservation(why=f'tool "{self._tool}" is {pose.status.value}: {pose.reason}')
        if pose.unseen_ns > 0:
            # A prediction is no measurement: what moves unseen is not where it was heading.
            return HoldObservation(why=f'nothing is seen of tool "{self._tool}"')
        return HoldObservation(Transform.from_pose(pose))


class StrobedMarkerObserver:
    """Positions of strobed markers, each from its newest strobe cycle.

    Args:
        spec: the markers.
        oldest_ns: age at which a place is too old in any case [ns].
    """

    def __init__(self, spec: WatchedStrobedMarkers, oldest_ns: int) -> None:
        self._row = {marker: row for row, marker in enumerate(spec.markers)}
        self._oldest_ns = np.full(len(spec.markers), oldest_ns)
        self._max_ns = oldest_ns
        self._places = np.full((len(spec.markers), 3), np.nan)
        self._covariances = np.zeros((len(spec.markers), 3, 3))
        self._times = np.zeros(len(spec.markers), np.int64)
        self._calibration: tuple[str | None, str | None] = None, None

    def of(self, batch: FrameBatch, index: int) -> HoldObservation:
        """Return the observation of the frame with this index."""
        frame = batch.frames[index]
        world = batch.calibration_id, batch.table_id
        if world != self._calibration:
            self._calibration = world
            self._places[:] = np.nan
        if frame.marker is None:
            return HoldObservation(why="all markers are lit together, and none is strobed")
        row = self._row.get(frame.marker)
        if row is None:
            return HoldObservation(why=self._missing())
        first, last = batch.owner.searchsorted((index, index + 1)).tolist()
        self._places[row] = np.nan
        for point in range(first, last):
            if not int(batch.points.flags[point]) & UNUSABLE_POINT:
                self._places[row] = batch.points.position_mm[point]
                self._covariances[row] = batch.points.covariance_mm2[point]
        now = frame.exposure_device_ns
        # Of a marker whose frames are lost the last place would stand for it until then.
        between = MAX_AGE_CYCLES * (now - self._times[row])
        self._oldest_ns[row] = between if 0 < between < self._max_ns else self._max_ns
        self._times[row] = now
        age = now - self._times
        self._places[(age < 0) | (age > self._oldest_ns)] = np.nan
        return HoldObservation(
            None,
            self._places.copy(),
            self._covariances.copy(),
            self._missing(),
            self._times.copy(),
        )

    def _missing(self) -> str | None:
        gone = ~np.isfinite(self._places[:, 0])
        numbers = [str(marker) for marker, row in self._row.items() if gone[row]]
        return None if not numbers else f"not seen: marker {', '.join(numbers)}"


class LitMarkerObserver:
    """Positions of markers that are lit together: the mutual nearest neighbour of each reference.

    A marker counts where its place and what was seen are nearest to each other, and nothing else
    that could be it is near.
    """

    def __init__(self, spec: WatchedLitMarkers, positions_mm: Array) -> None:
        self._spec = spec
        self._at = positions_mm

    def of(self, batch: FrameBatch, index: int) -> HoldObservation:
        """Return the observation of the frame with this index."""
        if batch.frames[index].marker is not None:
            return HoldObservation(why="the device strobes its markers; name them as strobed ones")
        seen, covariances = _lit(self._spec, batch, index)
        places = np.full((len(self._at), 3), np.nan)
        spread = np.zeros((len(self._at), 3, 3))
        for row, one in self._pairs(seen):
            places[row], spread[row] = seen[one], covariances[one]
        gone = np.flatnonzero(~np.isfinite(places[:, 0]))
        why = None
        if len(gone):
            listed = ", ".join(str(row + 1) for row in gone)
            why = (
                f"not seen within {self._spec.search_radius_mm:g} mm of its place, or not alone "
                f"there: marker {listed}"
            )
        return HoldObservation(None, places, spread, why)

    def _pairs(self, seen: Array) -> list[tuple[int, int]]:
        if not len(seen):
            return []
        apart = np.linalg.norm(seen - self._at[:, None], axis=2)  # place, seen
        nearest, back = apart.argmin(axis=1), apart.argmin(axis=0)
        near = apart <= self._spec.search_radius_mm
        mutual = {
            row: int(one) for row, one in enumerate(nearest) if back[one] == row and near[row, one]
        }
        left = np.ones(len(seen), np.bool_)
        left[list(mutual.values())] = False
        return [(row, one) for row, one in mutual.items() if not (near[row] & left).any()]


def lit_places(spec: WatchedLitMarkers, batch: FrameBatch, index: int) -> Array:
    """Return the positions in a frame whose markers are lit together, shape (N, 3) [mm]."""
    return _lit(spec, batch, index)[0] if batch.frames[index].marker is None else np.empty((0, 3))


def _lit(spec: WatchedLitMarkers, batch: FrameBatch, index: int) -> tuple[Array, Array]:
    return _tracks(batch, index) if spec.observed_as == "tracks" else _points(batch, index)


def _points(batch: FrameBatch, index: int) -> tuple[Array, Array]:
    first, last = batch.owner.searchsorted((index, index + 1)).tolist()
    points = batch.points
    good = np.isfinite(points.position_mm[first:last, 0])
    good &= (points.flags[first:last] & int(UNUSABLE_POINT)) == 0
    return points.position_mm[first:last][good], points.covariance_mm2[first:last][good]


def _tracks(batch: FrameBatch, index: int) -> tuple[Array, Array]:
    if batch.motion is None:
        return np.empty((0, 3)), np.empty((0, 3, 3))
    first, last = batch.motion.track_owner.searchsorted((index, index + 1)).tolist()
    own = batch.motion.tracks
    good = own.state[first:last] == int(TrackState.CONFIRMED)
    # Seen now, and not predicted; not every method says how well it fits.
    good &= (own.peaks[first:last] >= 0).any(axis=1)
    good &= (own.flags[first:last] & int(UNUSABLE_TRACK)) == 0
    return own.position_mm[first:last][good], own.covariance[first:last, :3, :3][good]
