"""BeamHoldRegistry: the beam holds of all devices; BeamHoldWatchdog holds when no frames come."""

import logging
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from threading import Condition, Thread
from typing import Final, Protocol

from service.pipeline.beam_hold_monitor import BeamHoldMonitor
from service.pipeline.frame_batch import BeamHoldState, FrameBatch
from service.pipeline.tracking_config import BeamHoldConfig

_log = logging.getLogger(__name__)

Publish = Callable[[str, BeamHoldState], None]
"""Tells the clients of a device."""
Listener = Callable[[str, BeamHoldState, bool], None]
"""Takes a device, one of its holds, and whether it is the last of that hold."""

DELETED = "the hold was deleted"


class BeamHoldRegistry:
    """Steps the beam holds with frames, and holds those whose deadline passes.

    Who processes frames steps it, the watchdog checks it, any thread reads it.

    A hold that is not held has a deadline: when its newest measurement will be older than it may
    be. Whoever comes first after it holds: the watchdog, the next frame, or who reads.

    Args:
        publish: tells the clients of a device of a change; called in order.
        monotonic_s: a clock that does not go back [s].
        wall_ns: the host's clock, that of the frames' host times [ns].
    """

    def __init__(
        self,
        publish: Publish,
        monotonic_s: Callable[[], float] = time.monotonic,
        wall_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        self._publish = publish
        self._monotonic_s = monotonic_s
        self._wall_ns = wall_ns
        self._set_up_here: set[str] = set()
        self._distrusted: dict[str, str] = {}
        self._watches: dict[str, BeamHoldMonitor] = {}
        self._devices: dict[str, tuple[BeamHoldMonitor, ...]] = {}
        self._published: dict[str, BeamHoldState] = {}
        self._due_s: dict[str, float] = {}
        self._listeners: list[Listener] = []
        self.changed = Condition()
        """Its lock is the registry's; notified when there is another deadline to watch."""

    def set(self, device_id: str, holds: Sequence[BeamHoldConfig]) -> None:
        """Replace the holds of a device; unchanged ones go on as they were.

        A hold of which anything but the reference changed keeps its latch. A latched hold whose
        reference was not taken since this registry was made must be acknowledged: nobody knows
        what happened before.
        """
        with self.changed:
            distrusted = self._distrusted.pop(device_id, None)
            now_ns = self._wall_ns()
            monitors: list[BeamHoldMonitor] = []
            for hold in holds:
                before = self._watches.get(hold.id)
                if before is not None and before.hold.device_id != device_id:
                    before = None
                if distrusted is not None and before is not None:
                    before.fail(distrusted, now_ns)
                if before is None or before.hold.key != hold.key:
                    before = self._new_monitor(hold, before, now_ns)
                monitors.append(before)
            ids = {hold.id for hold in holds}
            for monitor in self._devices.get(device_id, ()):
                if monitor.hold.id not in ids:
                    self._tell(monitor, monitor.end(DELETED, now_ns), last=True)
            self._devices[device_id] = tuple(monitors)
            for watch in monitors:
                self._watches[watch.hold.id] = watch
                self._tell(watch, watch.now, reason_changed=True)

    def set_up(self, reference_id: str) -> None:
        """Note that a reference is being set in this process."""
        with self.changed:
            self._set_up_here.add(reference_id)

    def distrust(self, device_id: str, why: str) -> None:
        """Hold all beams of a device until ``set`` is called: its holds could not be taken over."""
        with self.changed:
            self._distrusted[device_id] = why
            self.fail(device_id, why)

    def listen(self, listener: Listener) -> Callable[[], None]:
        """Call with every hold now, and from now on with every change, in order.

        It is called with the registry's lock held, so it must return at once.

        Returns:
            What ends it; may be called again.
        """
        with self.changed:
            self._check(self._monotonic_s())
            for device_id, watches in self._devices.items():
                for watch in watches:
                    listener(device_id, watch.now, False)
            self._listeners.append(listener)

        def end() -> None:
            with self.changed, suppress(ValueError):
                self._listeners.remove(listener)

        return end

    def take(self, batch: FrameBatch) -> tuple[tuple[BeamHoldState, ...], ...]:
        """Step a device's holds with all frames of a batch, and publish changes.

        Returns:
            The holds after each frame, by id; empty where the device has none.
        """
        if not self._devices.get(batch.device_id):
            return ()
        with self.changed:
            self._check(self._monotonic_s())
            watches = self._devices.get(batch.device_id, ())
            now_ns = self._wall_ns()
            states = [
                tuple(self._step(watch, batch, index, now_ns) for watch in watches)
                for index in range(len(batch.frames))
            ]
            for watch in watches:
                self._set_deadline(watch)
            # Not before: a release that is over by now is told to nobody.
            for after in states:
                for watch, now in zip(watches, after, strict=True):
                    self._tell(watch, now)
            self._check(self._monotonic_s())
            return tuple(states)

    def fail(self, device_id: str, why: str) -> None:
        """Hold all beams of a device: it was stopped, is disconnected, or was restarted."""
        with self.changed:
            for watch in self._devices.get(device_id, ()):
                self._tell(watch, watch.fail(why, self._wall_ns()), reason_changed=True)

    def forget(self, device_id: str) -> None:
        """Hold all beams of a device and forget its holds: it was deleted."""
        self.set(device_id, ())
        with self.changed:
            self._devices.pop(device_id, None)

    def acknowledge(self, hold_id: str) -> BeamHoldState | None:
        """End the latch of a hold and return it; None: there is no such hold."""
        with self.changed:
            watch = self._watches.get(hold_id)
            if watch is not None:
                watch.acknowledge()
        return self.now(hold_id)

    def now(self, hold_id: str) -> BeamHoldState | None:
        """Return the state of a hold; None: there is no such hold."""
        with self.changed:
            self._check(self._monotonic_s())
            watch = self._watches.get(hold_id)
            return None if watch is None else watch.now

    def of_device(self, device_id: str) -> tuple[BeamHoldState, ...]:
        """Return all holds of a device, by id."""
        with self.changed:
            self._check(self._monotonic_s())
            return tuple(watch.now for watch in self._devices.get(device_id, ()))

    def all(self) -> dict[str, tuple[BeamHoldState, ...]]:
        """Return the holds of every device."""
        return {device: self.of_device(device) for device in tuple(self._devices)}

    def check(self) -> float | None:
        """Hold beams past their deadline; return the time to the next deadline [s]; None: none."""
        with self.changed:
            now_s = self._monotonic_s()
            self._check(now_s)
            return min(self._due_s.values()) - now_s if self._due_s else None

    def _check(self, now_s: float) -> None:
        for hold_id, due_s in tuple(self._due_s.items()):
            if now_s < due_s:
                continue
            watch = self._watches[hold_id]
            gap_ms = watch.max_gap_ns * 1e-6
            late_ms = gap_ms + 1e3 * (now_s - due_s)
            why = f"nothing was measured for {late_ms:.0f} ms; at most {gap_ms:.0f} ms are allowed"
            if watch.why is not None:
                why = f"{why}; {watch.why}"
            self._tell(watch, watch.fail(why, self._wall_ns()), reason_changed=True)

    def _new_monitor(
        self, hold: BeamHoldConfig, before: BeamHoldMonitor | None, now_ns: int
    ) -> BeamHoldMonitor:
        reference = hold.reference
        latched, since_ns, why = False, None, None
        if before is not None:
            since_ns = before.fail("it was changed", now_ns).since_ns
            same = (before.hold.reference and before.hold.reference.id) == (
                reference and reference.id
            )
            latched = same and before.keeps_latch
            why = "the hold was changed" if same else "it has a new reference"
        elif reference is not None and reference.id not in self._set_up_here:
            latched = hold.limits.rules.latched
        if reference is not None:
            self._set_up_here.discard(reference.id)
        return BeamHoldMonitor(
            hold,
            latched=latched,
            time_ns=now_ns,
            since_ns=since_ns,
            why=why,
            monotonic_s=self._monotonic_s,
        )

    def _step(
        self, watch: BeamHoldMonitor, batch: FrameBatch, index: int, now_ns: int
    ) -> BeamHoldState:
        exposed_ns = batch.frames[index].exposure_host_ns
        distrusted = self._distrusted.get(batch.device_id)
        if distrusted is not None:
            return watch.fail(distrusted, exposed_ns)
        try:
            return watch.step(batch, index, now_ns - exposed_ns)
        except Exception as error:  # noqa: BLE001 - held, and the device goes on
            if watch.now.held and watch.now.reason == _failed(error):
                return watch.now
            _log.exception("hold %s cannot be watched", watch.hold.id)
            return watch.fail(_failed(error), exposed_ns)

    def _set_deadline(self, watch: BeamHoldMonitor) -> None:
        """Say until when a hold that is not held may stay so without a measurement."""
        hold_id = watch.hold.id
        release = watch.release
        if release is None or watch.measured_ns is None:
            self._due_s.pop(hold_id, None)
            return
        # A clock that is set back makes no measurement newer than it came.
        age_ns = max(0, self._wall_ns() - watch.measured_ns)
        first = hold_id not in self._due_s
        now_s = self._monotonic_s()
        release.due_s = self._due_s[hold_id] = now_s + 1e-9 * (watch.max_gap_ns - age_ns)
        if first:
            self.changed.notify_all()

    def _tell(
        self,
        watch: BeamHoldMonitor,
        now: BeamHoldState,
        *,
        reason_changed: bool = False,
        last: bool = False,
    ) -> None:
        """Tell of a change; ``reason_changed``: also where only the reason is another."""
        hold_id, device_id = watch.hold.id, watch.hold.device_id
        if watch.now.held:
            self._due_s.pop(hold_id, None)
        if now.superseded:
            return
        published = self._published.get(hold_id)
        changed = published is None or (published.held, published.cause) != (now.held, now.cause)
        if (
            changed
            or last
            or (reason_changed and published is not None and published.reason != now.reason)
        ):
            self._published[hold_id] = now
            for listener in tuple(self._listeners):
                listener(device_id, now, last)
            self._publish(device_id, now)
        if last:
            del self._watches[hold_id], self._published[hold_id]


def _failed(error: Exception) -> str:
    return f"it cannot be watched: {type(error).__name__}: {error}"


_AGAIN_S: Final = 0.05
"""Until a check that failed is tried again."""


class HoldDeadlines(Protocol):
    """Beam holds with deadlines."""

    changed: Condition

    def check(self) -> float | None:
        """Hold beams past their deadline; return the time to the next deadline [s]; None: none."""
        ...


class BeamHoldWatchdog:
    """Thread that checks a registry at each deadline, until ``close``.

    The compute thread runs on frames, and the event loop may be busy with requests; this thread
    has nothing else to do, and sleeps while all beams are held.
    """

    def __init__(self, registry: HoldDeadlines) -> None:
        self._registry = registry
        self._closing = False
        self._thread = Thread(target=self._run, name="hold-watchdog", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread."""
        with self._registry.changed:
            self._closing = True
            self._registry.changed.notify_all()
        self._thread.join(5.0)

    def _run(self) -> None:
        while not self._closing:
            # One hold of the lock for both: what is released in between would be waited for.
            with self._registry.changed:
                try:
                    wait_s = self._registry.check()
                except Exception:  # noqa: BLE001 - it must go on
                    _log.exception("beam holds could not be checked")
                    wait_s = _AGAIN_S
                if not self._closing:
                    self._registry.changed.wait(wait_s)
