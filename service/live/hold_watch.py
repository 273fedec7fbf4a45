"""HoldWatch: one beam hold of a running device, frame by frame, held whenever in doubt."""

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Final

import numpy as np

from compute.pose.frozen_image import FrozenImage
from compute.pose.hold import HoldMonitor, HoldState, MarkerHoldMonitor
from compute.pose.hold_gate import HoldCause
from service.live.batch import FrameBatch
from service.live.hold_now import HoldNow, Release
from service.live.hold_sight import LitSight, Shown, Sight, StrobedSight, ToolSight
from service.live.hold_spec import StrobedSpec, ToolSpec, WatchedHold

NO_REFERENCE: Final = (
    "it has no reference: POST /api/v1/holds/{id}/reference while all is where it is to be"
)


class HoldWatch:
    """Steps a monitor with what frames show, and says since when it is held, on the host's clock.

    Not thread-safe: the board has the lock.

    Args:
        hold: what is watched.
        latched: whether the first hold is to be acknowledged: it goes on from another's.
        time_ns: now, on the host's clock [ns].
        since_ns: since when the beam is held already; None: since now.
        why: what took its place, for a person; None: nothing did.
        monotonic_s: a clock that does not go back [s].
    """

    def __init__(
        self,
        hold: WatchedHold,
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
        self._release: Release | None = None
        self._monitor = _monitor(hold, latched=latched)
        self._sight = _sight(hold)
        self._image = FrozenImage()
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
        self._now = HoldNow(hold.id, True, HoldCause.NO_DATA, told, began_ns)

    @property
    def now(self) -> HoldNow:
        """The hold after the newest frame, or what came after it."""
        return self._now

    @property
    def release(self) -> Release | None:
        """What says that the beam is not held; None: it is."""
        return self._release

    def _set(self, now: HoldNow) -> HoldNow:
        """Keep a state; one that holds ends all that said before that the beam may go on."""
        if now.held:
            if self._release is not None:
                self._release.end(now)
            self._release = None
        else:
            if self._release is None:
                self._release = Release(self._monotonic_s)
            now = replace(now, release=self._release)
        self._now = now
        return now

    @property
    def keeps_latch(self) -> bool:
        """Whether what takes its place has to be acknowledged before it releases."""
        return self._latched if self._monitor is None else self._monitor.keeps_latch

    @property
    def measured_ns(self) -> int | None:
        """When the oldest of what is needed was measured [host's ns]; None: not since a hold."""
        return self._measured_ns

    @property
    def most_gap_ns(self) -> int:
        """Longest time without a measurement before the beam is held [ns]."""
        return self.hold.limits.rules.most_gap_ns

    def step(self, batch: FrameBatch, index: int, age_ns: int = 0) -> HoldNow:
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
            shown = Shown(why="the device sends the same image again and again: it is frozen")
        if age_ns > self.most_gap_ns:
            shown = Shown(why=f"frames come {age_ns * 1e-6:.0f} ms after their exposure")
        self.why = shown.why
        before_ns, exposed_ns = self._monitor.seen_ns, frame.exposure_device_ns
        state = self._stepped(exposed_ns, shown)
        seen_ns = self._monitor.seen_ns
        if seen_ns is not None and seen_ns != before_ns:
            self._measured_ns = frame.exposure_host_ns - (exposed_ns - seen_ns)
        reason = state.reason
        if state.cause is HoldCause.NO_DATA and shown.why and shown.why not in str(reason):
            reason = f"{reason}; {shown.why}"
        since = frame.exposure_host_ns if state.hold != self.now.held else self.now.since_ns
        return self._set(HoldNow.of(self.hold.id, state, reason, since, *self._last))

    def fail(self, why: str, time_ns: int) -> HoldNow:
        """Hold now.

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

    def end(self, why: str, time_ns: int) -> HoldNow:
        """Hold for good; arguments as of ``fail``."""
        since = self.now.since_ns if self.now.held else time_ns
        return self._set(self._held(HoldCause.NO_DATA, why, since))

    def acknowledge(self) -> None:
        """End a latch; a hold ends with the next frames, if all is back."""
        self._latched = False
        if self._monitor is not None:
            self._monitor.acknowledge()

    def _held(self, cause: HoldCause, reason: str | None, since_ns: int) -> HoldNow:
        return HoldNow(self.hold.id, True, cause, reason, since_ns, *self._last)

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
            now = f'"{batch.calibration_id}" is in force'
        else:
            then = _with_table(reference.table_id)
            now = f"readings are corrected {_with_table(batch.table_id)} now"
        return f"its reference was taken {then}, and {now}: take it again"

    def _frozen(self, batch: FrameBatch, index: int) -> bool:
        """Return whether a frame shows what was shown before; of tools their tracker knows it."""
        spec = self.hold.spec
        if isinstance(spec, ToolSpec):
            return False
        sensors = len(batch.sensor_names)
        lines = slice(index * sensors, (index + 1) * sensors)
        self._image.see(
            batch.frames[index].marker,
            batch.peaks.position_px[lines],
            batch.peaks.sigma_px[lines].astype(np.float64),
        )
        return self._image.of(spec.markers if isinstance(spec, StrobedSpec) else None)

    def _stepped(self, time_ns: int, shown: Shown) -> HoldState:
        if isinstance(self._monitor, HoldMonitor):
            return self._monitor.step(time_ns, shown.pose)
        assert self._monitor is not None
        spread = shown.covariances_mm2
        reference = self.hold.reference
        if spread is not None and reference is not None and reference.covariances_mm2 is not None:
            spread = spread + reference.covariances_mm2
        return self._monitor.step(time_ns, shown.places_mm, spread, shown.times_ns)


def _with_table(table_id: str | None) -> str:
    return "without a correction table" if table_id is None else f'by table "{table_id}"'


def _monitor(hold: WatchedHold, *, latched: bool) -> HoldMonitor | MarkerHoldMonitor | None:
    reference, spec = hold.reference, hold.spec
    if reference is None:
        return None
    if isinstance(spec, ToolSpec):
        assert reference.pose is not None
        axes = None if spec.axes is None else np.array(spec.axes)
        target = np.array(spec.target_mm)
        return HoldMonitor(reference.pose, hold.limits, target, axes, latched=latched)
    assert reference.places_mm is not None
    names = tuple(map(str, spec.markers)) if isinstance(spec, StrobedSpec) else None
    return MarkerHoldMonitor(
        reference.places_mm, hold.limits, spec.least_markers, names, latched=latched
    )


def _sight(hold: WatchedHold) -> Sight | None:
    spec, reference = hold.spec, hold.reference
    if isinstance(spec, ToolSpec):
        return ToolSight(spec)
    if isinstance(spec, StrobedSpec):
        return StrobedSight(spec, hold.limits.rules.most_gap_ns)
    return None if reference is None else LitSight(spec, np.asarray(reference.places_mm))
