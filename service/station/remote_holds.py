"""RemoteHolds: the beam holds of a station as its gateway knows them."""

import logging
import time
from collections.abc import Callable, Sequence, Set
from contextlib import suppress
from dataclasses import replace
from threading import Condition
from typing import Final

from service.pipeline.beam_hold_registry import DELETED, Listener
from service.pipeline.frame_batch import BeamEnableToken, BeamHoldState

_log = logging.getLogger(__name__)

GRACE_S: Final = 0.05
"""How long after a deadline the station's own word for it is waited for."""

Acknowledge = Callable[[str], bool]
SetUp = Callable[[str], None]
Publish = Callable[[str, BeamHoldState], None]


class RemoteHolds:
    """Keeps the newest state of each hold, and the tokens of those that are enabled.

    The station decides. A beam that it says is enabled is held here when its deadline passes
    without a word, and when the station is lost: its deadlines are those of this machine's clock.

    Args:
        acknowledge: ends the latch of a hold at the station; returns whether there is one.
        set_up: notes at the station that a reference is being set.
        publish: tells the clients of a device of a change.
    """

    def __init__(self, acknowledge: Acknowledge, set_up: SetUp, publish: Publish) -> None:
        self._acknowledge = acknowledge
        self.set_up = set_up
        self._publish = publish
        self._states: dict[str, dict[str, BeamHoldState]] = {}
        self._tokens: dict[str, BeamEnableToken] = {}
        self._last_held: dict[str, BeamHoldState] = {}
        self._lapsed: set[str] = set()
        """Holds whose deadline passed here: clients may have been told that they hold."""
        self._listeners: list[Listener] = []
        self.silence: str | None = None
        """Why nothing can come from the station now; None: there is no reason."""
        self.changed = Condition()
        """Its lock is that of the states; notified when there is another deadline to watch."""

    def enabled(self, hold_id: str, revision: int, due_s: float) -> BeamEnableToken:
        """Return the token of a state that is not held; see ``HoldTokens``."""
        with self.changed:
            held = self._last_held.get(hold_id)
            if held is not None and revision < held.revision:
                token = BeamEnableToken(time.monotonic)
                token.ended = held
                return token
            known = self._tokens.get(hold_id)
            if known is None:
                known = self._tokens[hold_id] = BeamEnableToken(time.monotonic)
                self.changed.notify_all()
            elif known.over:
                self._lapsed.add(hold_id)
            known.due_s = max(known.due_s, due_s)
            return known

    def held(self, now: BeamHoldState) -> None:
        """End the token of a hold; see ``HoldTokens``."""
        with self.changed:
            before = self._last_held.get(now.hold_id)
            if before is None or now.revision > before.revision:
                self._last_held[now.hold_id] = now
                token = self._tokens.pop(now.hold_id, None)
                if token is not None:
                    token.ended = now

    def take(self, device_id: str, newest: Sequence[BeamHoldState]) -> None:
        """Keep the newest states of a batch; their changes have come before it."""
        with self.changed:
            for now in newest:
                self._keep(device_id, now)
                if now.hold_id in self._lapsed and not now.standing.held:
                    # The station has never held it, and tells of no change.
                    self._lapsed.discard(now.hold_id)
                    self._tell(device_id, now, last=False)

    def change(self, device_id: str, now: BeamHoldState, *, last: bool) -> None:
        """Take a change, and tell of it; ``last``: the hold was deleted."""
        with self.changed:
            self._keep(device_id, now)
            self._lapsed.discard(now.hold_id)
            if last:
                # When it was held last stays: a batch on its way may say that it is enabled.
                self._states.get(device_id, {}).pop(now.hold_id, None)
                self._tokens.pop(now.hold_id, None)
            self._tell(device_id, now, last=last)

    def keep(self, device_id: str, hold_ids: Set[str]) -> None:
        """Tell of all other holds of a device that they were deleted: the station has no others."""
        with self.changed:
            states = self._states.get(device_id, {})
            for hold_id in states.keys() - hold_ids:
                self.change(device_id, states[hold_id].held_because(DELETED), last=True)

    def fail(self, why: str) -> None:
        """Hold all beams: the station is lost."""
        with self.changed:
            now_ns = time.time_ns()
            for device_id, states in self._states.items():
                for now in tuple(states.values()):
                    since_ns = now.since_ns if now.held else now_ns
                    self._hold(device_id, replace(now.held_because(why), since_ns=since_ns))
            # The next station counts anew.
            self._last_held.clear()
            self._states = {
                device_id: {name: replace(now, revision=0) for name, now in states.items()}
                for device_id, states in self._states.items()
            }

    def listen(self, listener: Listener) -> Callable[[], None]:
        """Call with every hold now, and from now on with every change, in order.

        It is called with a lock held, so it must return at once.

        Returns:
            What ends it; may be called again.
        """
        with self.changed:
            for device_id, states in self._states.items():
                for now in states.values():
                    listener(device_id, now.standing, False)
            self._listeners.append(listener)

        def end() -> None:
            with self.changed, suppress(ValueError):
                self._listeners.remove(listener)

        return end

    def acknowledge(self, hold_id: str) -> BeamHoldState | None:
        """End the latch of a hold and return it; None: there is no such hold."""
        self._acknowledge(hold_id)
        return self.now(hold_id)

    def now(self, hold_id: str) -> BeamHoldState | None:
        """Return the state of a hold; None: there is no such hold."""
        with self.changed:
            for states in self._states.values():
                if hold_id in states:
                    return states[hold_id].standing
            return None

    def of_device(self, device_id: str) -> tuple[BeamHoldState, ...]:
        """Return all holds of a device, by id."""
        with self.changed:
            states = self._states.get(device_id, {})
            return tuple(states[hold_id].standing for hold_id in sorted(states))

    def all(self) -> dict[str, tuple[BeamHoldState, ...]]:
        """Return the holds of every device."""
        return {device_id: self.of_device(device_id) for device_id in tuple(self._states)}

    def check(self) -> float | None:
        """Hold beams past their deadline; return the time to the next one [s]; None: none."""
        with self.changed:
            now_s = time.monotonic()
            for device_id, states in self._states.items():
                for now in tuple(states.values()):
                    token = self._tokens.get(now.hold_id)
                    if token is not None and now_s >= token.due_s + GRACE_S:
                        why = (
                            "the station has not said for longer than is allowed that it may go on"
                        )
                        if self.silence is not None:
                            why = f"{why}; {self.silence}"
                        self._hold(device_id, now.held_because(why))
            due = [token.due_s for token in self._tokens.values()]
            return min(due) + GRACE_S - now_s if due else None

    def _hold(self, device_id: str, now: BeamHoldState) -> None:
        token = self._tokens.pop(now.hold_id, None)
        if token is not None:
            token.ended = now
        self._states[device_id][now.hold_id] = now
        self._lapsed.add(now.hold_id)
        self._tell(device_id, now, last=False)

    def _keep(self, device_id: str, now: BeamHoldState) -> None:
        states = self._states.setdefault(device_id, {})
        known = (states.get(now.hold_id), self._last_held.get(now.hold_id))
        if all(one is None or now.revision >= one.revision for one in known):
            states[now.hold_id] = now

    def _tell(self, device_id: str, now: BeamHoldState, *, last: bool) -> None:
        for listener in tuple(self._listeners):
            listener(device_id, now, last)
        self._publish(device_id, now)
