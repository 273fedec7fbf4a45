"""BeamHoldMonitor: state of one beam hold, frame by frame; any fault or gap holds the beam."""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import count
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.pose.beam_hold import (
    BeamHoldCause,
    BeamHoldDecision,
    MarkerDeviationMonitor,
    PoseDeviationMonitor,
)
from compute.pose.tool_tracking.exposure_history import StaleDataDetector
from compute.reconstruction.point_batch import PointFlag
from compute.tracking.track_batch import TrackFlag, TrackState
from compute.transform import Transform
from service.pipeline.frame_batch import BeamEnableToken, BeamHoldState, FrameBatch, Vector
from service.pipeline.tracking_config import (
    BeamHoldConfig,
    WatchedLitMarkers,
    WatchedStrobedMarkers,
    WatchedTool,
)

Array = NDArray[np.float64]

UNUSABLE_POINT: Final = (
    PointFlag.INCONSISTENT
    | PointFlag.AMBIGUOUS
    | PointFlag.OUTSIDE_MAP
    | PointFlag.READING_EXCLUDED
)
UNUSABLE_TRACK: Final = TrackFlag.AMBIGUOUS | TrackFlag.OUTSIDE_MAP
MAX_AGE_CYCLES: Final = 2
"""A position is too old after this many times the interval between its last two strobe cycles."""
NO_REFERENCE: Final = (
    "it has no reference: POST /api/v1/beam-holds/{id}/reference while all is where it is to be"
)


@dataclass(frozen=True, eq=False)
class HoldObservation:
    """Observation of a hold's target in one frame.

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
        return HoldObservation(pose.transform())


class StrobedMarkerObserver:
    """Positions of strobed markers, each from its newest strobe cycle."""

    def __init__(self, spec: WatchedStrobedMarkers, max_age_ns: int) -> None:
        self._row = {marker: row for row, marker in enumerate(spec.markers)}
        self._max_ages_ns = np.full(len(spec.markers), max_age_ns)
        self._max_age_ns = max_age_ns
        self._positions = np.full((len(spec.markers), 3), np.nan)
        self._covariances = np.zeros((len(spec.markers), 3, 3))
        self._times = np.zeros(len(spec.markers), np.int64)
        self._calibration: tuple[str | None, str | None] = None, None

    def of(self, batch: FrameBatch, index: int) -> HoldObservation:
        """Return the observation of the frame with this index."""
        frame = batch.frames[index]
        world = batch.calibration_id, batch.table_id
        if world != self._calibration:
            self._calibration = world
            self._positions[:] = np.nan
        if frame.marker is None:
            return HoldObservation(why="all markers are lit together, and none is strobed")
        row = self._row.get(frame.marker)
        if row is None:
            return HoldObservation(why=self._missing())
        self._positions[row] = np.nan
        points = batch.points_of(index)
        for point, flags in enumerate(points.flags.tolist()):
            if not flags & UNUSABLE_POINT:
                self._positions[row] = points.position_mm[point]
                self._covariances[row] = points.covariance_mm2[point]
        now = frame.exposure_device_ns
        # Of a marker whose frames are lost the last position would stand for it until then.
        cycles_ns = MAX_AGE_CYCLES * (now - self._times[row])
        in_range = 0 < cycles_ns < self._max_age_ns
        self._max_ages_ns[row] = cycles_ns if in_range else self._max_age_ns
        self._times[row] = now
        age = now - self._times
        self._positions[(age < 0) | (age > self._max_ages_ns)] = np.nan
        return HoldObservation(
            None,
            self._positions.copy(),
            self._covariances.copy(),
            self._missing(),
            self._times.copy(),
        )

    def _missing(self) -> str | None:
        missing = ~np.isfinite(self._positions[:, 0])
        numbers = [str(marker) for marker, row in self._row.items() if missing[row]]
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
        lit_mm, covariances = _lit(self._spec, batch, index)
        positions = np.full((len(self._at), 3), np.nan)
        covariance = np.zeros((len(self._at), 3, 3))
        for row, one in self._pairs(lit_mm):
            positions[row], covariance[row] = lit_mm[one], covariances[one]
        missing = np.flatnonzero(~np.isfinite(positions[:, 0]))
        why = None
        if len(missing):
            listed = ", ".join(str(row + 1) for row in missing)
            why = (
                f"not seen within {self._spec.search_radius_mm:g} mm of its place, or not alone "
                f"there: marker {listed}"
            )
        return HoldObservation(None, positions, covariance, why)

    def _pairs(self, lit_mm: Array) -> list[tuple[int, int]]:
        if not len(lit_mm):
            return []
        apart = np.linalg.norm(lit_mm - self._at[:, None], axis=2)  # position, lit marker
        nearest, back = apart.argmin(axis=1), apart.argmin(axis=0)
        near = apart <= self._spec.search_radius_mm
        mutual = {
            row: int(one) for row, one in enumerate(nearest) if back[one] == row and near[row, one]
        }
        unmatched = np.ones(len(lit_mm), np.bool_)
        unmatched[list(mutual.values())] = False
        return [(row, one) for row, one in mutual.items() if not (near[row] & unmatched).any()]


HoldObserver = ToolObserver | StrobedMarkerObserver | LitMarkerObserver


def lit_places(spec: WatchedLitMarkers, batch: FrameBatch, index: int) -> Array:
    """Return the positions in a frame whose markers are lit together, shape (N, 3) [mm]."""
    return _lit(spec, batch, index)[0] if batch.frames[index].marker is None else np.empty((0, 3))


def _lit(spec: WatchedLitMarkers, batch: FrameBatch, index: int) -> tuple[Array, Array]:
    """Return positions and covariances of the usable points, or tracks, of a frame."""
    if spec.observed_as == "points":
        points = batch.points_of(index)
        good = np.isfinite(points.position_mm[:, 0])
        good &= (points.flags & int(UNUSABLE_POINT)) == 0
        return points.position_mm[good], points.covariance_mm2[good]
    if batch.motion is None:
        return np.empty((0, 3)), np.empty((0, 3, 3))
    first, last = batch.motion.track_owner.searchsorted((index, index + 1)).tolist()
    own = batch.motion.tracks
    good = own.state[first:last] == int(TrackState.CONFIRMED)
    # Seen now, and not predicted; not every method says how well it fits.
    good &= (own.peaks[first:last] >= 0).any(axis=1)
    good &= (own.flags[first:last] & int(UNUSABLE_TRACK)) == 0
    return own.position_mm[first:last][good], own.covariance[first:last, :3, :3][good]


_REVISIONS: Final = count(1)


class BeamHoldMonitor:
    """Feeds a deviation monitor with observations, and keeps the state of its hold.

    Not thread-safe: the registry has the lock.

    Args:
        hold: what is watched.
        latched: whether the first hold must be acknowledged: it continues a predecessor's.
        time_ns: now, on the host's clock [ns].
        since_ns: since when the beam is held already; None: since now.
        why: why it replaces a predecessor, for a person; None: it replaces none.
        monotonic_s: a clock that does not go back [s].
    """

    def __init__(
        self,
        hold: BeamHoldConfig,
        *,
        latched: bool,
        time_ns: int,
        since_ns: int | None = None,
        why: str | None = None,
        monotonic_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self.hold = hold
        self._latched = latched
        self._monotonic_s = monotonic_s
        self._monitor = _deviation_monitor(hold, latched=latched)
        self._observer = _observer(hold)
        self._stale_data = StaleDataDetector()
        self._last: tuple[int | None, int | None] = None, None  # host time and number of a frame
        self.release: BeamEnableToken | None = None
        """Token of the time in which the beam is enabled; None: it is held."""
        self.measured_ns: int | None = None
        """Time of the oldest measurement that counts, host clock [ns]; None: none since a hold."""
        self.why: str | None = None
        """Why the newest frame showed not all that is watched; None: it did, or none came."""
        reason = "nothing was measured yet"
        if self._monitor is None:
            reason = NO_REFERENCE.format(id=hold.id)
        elif why is not None:
            reason = f"{why}, and nothing was measured since"
            self._monitor.fail(reason)
        self.now = self._held_state(
            BeamHoldCause.NO_DATA, reason, time_ns if since_ns is None else since_ns
        )
        """State after the newest frame, or after a later event."""

    @property
    def keeps_latch(self) -> bool:
        """Whether its successor must be acknowledged before it enables the beam."""
        return self._latched if self._monitor is None else self._monitor.must_acknowledge

    @property
    def max_gap_ns(self) -> int:
        """Longest time without a measurement before the beam is held [ns]."""
        return self.hold.limits.rules.max_gap_ns

    def step(self, batch: FrameBatch, index: int, age_ns: int = 0) -> BeamHoldState:
        """Return the state after a frame.

        Args:
            batch: frames.
            index: of the frame.
            age_ns: time since its exposure; one that is older than the longest gap is no
                measurement.
        """
        frame = batch.frames[index]
        self._last = frame.exposure_host_ns, frame.sequence
        unfit = self._reference_mismatch(batch)
        if self._monitor is None or self._observer is None:
            return self._set(self._held_state(self.now.cause, self.now.reason, self.now.since_ns))
        if unfit is not None:
            return self.fail(unfit, frame.exposure_host_ns)
        observed = self._observer.of(batch, index)
        if self._is_stale(batch, index):
            observed = HoldObservation(
                why="the device sends the same image again and again: it is frozen"
            )
        if age_ns > self.max_gap_ns:
            late_ms = age_ns * 1e-6
            observed = HoldObservation(why=f"frames come {late_ms:.0f} ms after their exposure")
        self.why = observed.why
        before_ns, exposed_ns = self._monitor.measured_ns, frame.exposure_device_ns
        decision = self._decide(exposed_ns, observed)
        seen_ns = self._monitor.measured_ns
        if seen_ns is not None and seen_ns != before_ns:
            self.measured_ns = frame.exposure_host_ns - (exposed_ns - seen_ns)
        reason = decision.reason
        no_data = decision.cause is BeamHoldCause.NO_DATA
        if no_data and observed.why and observed.why not in str(reason):
            reason = f"{reason}; {observed.why}"
        unchanged = decision.hold == self.now.held
        return self._set(
            BeamHoldState(
                self.hold.id,
                decision.hold,
                decision.cause,
                reason,
                self.now.since_ns if unchanged else frame.exposure_host_ns,
                *self._last,
                _vector(decision.shift_mm),
                _vector(decision.rotation_rad),
                decision.probability,
                revision=next(_REVISIONS),
            )
        )

    def fail(self, why: str, time_ns: int) -> BeamHoldState:
        """Hold the beam now."""
        self.measured_ns = None
        if self._monitor is not None:
            decision = self._monitor.fail(why)
            self._set(self._held_state(decision.cause, decision.reason, self._held_since(time_ns)))
        return self.now

    def end(self, why: str, time_ns: int) -> BeamHoldState:
        """Hold the beam for good; arguments as of ``fail``."""
        return self._set(self._held_state(BeamHoldCause.NO_DATA, why, self._held_since(time_ns)))

    def acknowledge(self) -> None:
        """End a latch; the hold ends with the next frames, if all is within its limits."""
        self._latched = False
        if self._monitor is not None:
            self._monitor.acknowledge()

    def _set(self, now: BeamHoldState) -> BeamHoldState:
        """Keep a state; one that holds ends all that said before that the beam may go on."""
        if now.held:
            if self.release is not None:
                self.release.ended = now
            self.release = None
        else:
            if self.release is None:
                self.release = BeamEnableToken(self._monotonic_s)
            now = replace(now, release=self.release)
        self.now = now
        return now

    def _held_state(self, cause: BeamHoldCause, reason: str | None, since_ns: int) -> BeamHoldState:
        return BeamHoldState(
            self.hold.id, True, cause, reason, since_ns, *self._last, revision=next(_REVISIONS)
        )

    def _held_since(self, time_ns: int) -> int:
        return self.now.since_ns if self.now.held else time_ns

    def _reference_mismatch(self, batch: FrameBatch) -> str | None:
        """Return why frames cannot be compared with the reference; None: they can."""
        reference = self.hold.reference
        if reference is None or (batch.calibration_id, batch.table_id) == (
            reference.calibration_id,
            reference.table_id,
        ):
            return None
        if batch.calibration_id is None:
            return "the device has no active calibration"
        if batch.calibration_id != reference.calibration_id:
            then = (
                "without a calibration"
                if reference.calibration_id is None
                else f'with calibration "{reference.calibration_id}"'
            )
            now = f'"{batch.calibration_id}" is active'
        else:
            then = _with_table(reference.table_id)
            now = f"readings are corrected {_with_table(batch.table_id)} now"
        return f"its reference was taken {then}, and {now}: take it again"

    def _is_stale(self, batch: FrameBatch, index: int) -> bool:
        """Return whether a frame repeats the one before; of tools their tracker knows it."""
        spec = self.hold.spec
        if isinstance(spec, WatchedTool):
            return False
        sensors = len(batch.sensor_names)
        scans = slice(index * sensors, (index + 1) * sensors)
        self._stale_data.add_exposure(
            batch.frames[index].marker,
            batch.peaks.position_px[scans],
            batch.peaks.sigma_px[scans].astype(np.float64),
        )
        markers = spec.markers if isinstance(spec, WatchedStrobedMarkers) else None
        return self._stale_data.is_stale(markers)

    def _decide(self, time_ns: int, observed: HoldObservation) -> BeamHoldDecision:
        if isinstance(self._monitor, PoseDeviationMonitor):
            return self._monitor.step(time_ns, observed.pose)
        assert self._monitor is not None
        covariance, reference = observed.covariances_mm2, self.hold.reference
        if covariance is not None and reference and reference.covariances_mm2 is not None:
            covariance = covariance + reference.covariances_mm2
        return self._monitor.step(time_ns, observed.positions_mm, covariance, observed.times_ns)


def _vector(values: Array | None) -> Vector | None:
    if values is None:
        return None
    x, y, z = values.tolist()
    return x, y, z


def _with_table(table_id: str | None) -> str:
    return "without a correction table" if table_id is None else f'by table "{table_id}"'


def _deviation_monitor(
    hold: BeamHoldConfig, *, latched: bool
) -> PoseDeviationMonitor | MarkerDeviationMonitor | None:
    reference, spec = hold.reference, hold.spec
    if reference is None:
        return None
    if isinstance(spec, WatchedTool):
        assert reference.pose is not None
        axes = None if spec.axes is None else np.array(spec.axes)
        target = np.array(spec.target_mm)
        return PoseDeviationMonitor(reference.pose, hold.limits, target, axes, latched=latched)
    assert reference.positions_mm is not None
    names = tuple(map(str, spec.markers)) if isinstance(spec, WatchedStrobedMarkers) else None
    return MarkerDeviationMonitor(
        reference.positions_mm, hold.limits, spec.min_markers, names, latched=latched
    )


def _observer(hold: BeamHoldConfig) -> HoldObserver | None:
    spec, reference = hold.spec, hold.reference
    if isinstance(spec, WatchedTool):
        return ToolObserver(spec)
    if isinstance(spec, WatchedStrobedMarkers):
        return StrobedMarkerObserver(spec, hold.limits.rules.max_gap_ns)
    return (
        None if reference is None else LitMarkerObserver(spec, np.asarray(reference.positions_mm))
    )
