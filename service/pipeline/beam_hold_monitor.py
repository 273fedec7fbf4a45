"""BeamHoldMonitor: state of one beam hold, frame by frame; any fault or gap holds the beam."""

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Final

import numpy as np

from compute.pose.beam_hold import (
    BeamHoldCause,
    BeamHoldDecision,
    MarkerDeviationMonitor,
    PoseDeviationMonitor,
)
from compute.pose.tool_tracking.exposure_history import StaleDataDetector
from service.pipeline.beam_hold_observer import (
    HoldObservation,
    HoldObserver,
    LitMarkerObserver,
    StrobedMarkerObserver,
    ToolObserver,
)
from service.pipeline.beam_hold_spec import BeamHoldConfig, WatchedStrobedMarkers, WatchedTool
from service.pipeline.beam_hold_state import BeamEnableToken, BeamHoldState
from service.pipeline.frame_batch import FrameBatch

NO_REFERENCE: Final = (
    "it has no reference: POST /api/v1/beam-holds/{id}/reference while all is where it is to be"
)


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
        self._release: BeamEnableToken | None = None
        self._monitor = _monitor(hold, latched=latched)
        self._sight = _sight(hold)
        self._image = StaleDataDetector()
        self._last: tuple[int | None, int | None] = None, None  # host time and number of a frame
        self._measured_ns: int | None = None
        self.why: str | None = None
        """Why the newest frame showed not all that is watched; None: it did, or none came."""
        told = "nothing was measured yet"
        if self._monitor is None:
            told = NO_REFERENCE.format(id=hold.id)
        elif why is not None:
            told = f"{why}, and nothing was measured since"
            self._monitor.fail(told)
        began_ns = time_ns if since_ns is None else since_ns
        self._now = BeamHoldState(hold.id, True, BeamHoldCause.NO_DATA, told, began_ns)

    @property
    def now(self) -> BeamHoldState:
        """State after the newest frame, or after a later event."""
        return self._now

    @property
    def release(self) -> BeamEnableToken | None:
        """Token of the time in which the beam is enabled; None: it is held."""
        return self._release

    def _set(self, now: BeamHoldState) -> BeamHoldState:
        """Keep a state; one that holds ends all that said before that the beam may go on."""
        if now.held:
            if self._release is not None:
                self._release.end(now)
            self._release = None
        else:
            if self._release is None:
                self._release = BeamEnableToken(self._monotonic_s)
            now = replace(now, release=self._release)
        self._now = now
        return now

    @property
    def keeps_latch(self) -> bool:
        """Whether its successor must be acknowledged before it enables the beam."""
        return self._latched if self._monitor is None else self._monitor.must_acknowledge

    @property
    def measured_ns(self) -> int | None:
        """Time of the oldest measurement that counts, host clock [ns]; None: none since a hold."""
        return self._measured_ns

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
        why = self._unfit(batch)
        if self._monitor is None or self._sight is None:
            return self._set(self._held(self.now.cause, self.now.reason, self.now.since_ns))
        if why is not None:
            return self.fail(why, frame.exposure_host_ns)
        shown = self._sight.of(batch, index)
        if self._frozen(batch, index):
            shown = HoldObservation(
                why="the device sends the same image again and again: it is frozen"
            )
        if age_ns > self.max_gap_ns:
            shown = HoldObservation(why=f"frames come {age_ns * 1e-6:.0f} ms after their exposure")
        self.why = shown.why
        before_ns, exposed_ns = self._monitor.measured_ns, frame.exposure_device_ns
        state = self._stepped(exposed_ns, shown)
        seen_ns = self._monitor.measured_ns
        if seen_ns is not None and seen_ns != before_ns:
            self._measured_ns = frame.exposure_host_ns - (exposed_ns - seen_ns)
        reason = state.reason
        if state.cause is BeamHoldCause.NO_DATA and shown.why and shown.why not in str(reason):
            reason = f"{reason}; {shown.why}"
        since = frame.exposure_host_ns if state.hold != self.now.held else self.now.since_ns
        return self._set(BeamHoldState.of(self.hold.id, state, reason, since, *self._last))

    def fail(self, why: str, time_ns: int) -> BeamHoldState:
        """Hold the beam now.

        Args:
            why: for a person.
            time_ns: now, on the host's clock [ns].
        """
        since = self.now.since_ns if self.now.held else time_ns
        self._measured_ns = None
        if self._monitor is not None:
            state = self._monitor.fail(why)
            self._set(self._held(state.cause, state.reason, since))
        return self.now

    def end(self, why: str, time_ns: int) -> BeamHoldState:
        """Hold the beam for good; arguments as of ``fail``."""
        since = self.now.since_ns if self.now.held else time_ns
        return self._set(self._held(BeamHoldCause.NO_DATA, why, since))

    def acknowledge(self) -> None:
        """End a latch; the hold ends with the next frames, if all is within its limits."""
        self._latched = False
        if self._monitor is not None:
            self._monitor.acknowledge()

    def _held(self, cause: BeamHoldCause, reason: str | None, since_ns: int) -> BeamHoldState:
        return BeamHoldState(self.hold.id, True, cause, reason, since_ns, *self._last)

    def _unfit(self, batch: FrameBatch) -> str | None:
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

    def _frozen(self, batch: FrameBatch, index: int) -> bool:
        """Return whether a frame shows what was shown before; of tools their tracker knows it."""
        spec = self.hold.spec
        if isinstance(spec, WatchedTool):
            return False
        sensors = len(batch.sensor_names)
        lines = slice(index * sensors, (index + 1) * sensors)
        self._image.add_exposure(
            batch.frames[index].marker,
            batch.peaks.position_px[lines],
            batch.peaks.sigma_px[lines].astype(np.float64),
        )
        return self._image.is_stale(
            spec.markers if isinstance(spec, WatchedStrobedMarkers) else None
        )

    def _stepped(self, time_ns: int, shown: HoldObservation) -> BeamHoldDecision:
        if isinstance(self._monitor, PoseDeviationMonitor):
            return self._monitor.step(time_ns, shown.pose)
        assert self._monitor is not None
        spread = shown.covariances_mm2
        reference = self.hold.reference
        if spread is not None and reference is not None and reference.covariances_mm2 is not None:
            spread = spread + reference.covariances_mm2
        return self._monitor.step(time_ns, shown.positions_mm, spread, shown.times_ns)


def _with_table(table_id: str | None) -> str:
    return "without a correction table" if table_id is None else f'by table "{table_id}"'


def _monitor(
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


def _sight(hold: BeamHoldConfig) -> HoldObserver | None:
    spec, reference = hold.spec, hold.reference
    if isinstance(spec, WatchedTool):
        return ToolObserver(spec)
    if isinstance(spec, WatchedStrobedMarkers):
        return StrobedMarkerObserver(spec, hold.limits.rules.max_gap_ns)
    return (
        None if reference is None else LitMarkerObserver(spec, np.asarray(reference.positions_mm))
    )
