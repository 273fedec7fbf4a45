"""Beam hold state machine: when a hold begins, and when it may end."""

from dataclasses import dataclass
from enum import StrEnum

from compute.errors import InvalidParameter


class BeamHoldCause(StrEnum):
    """Why the beam is held."""

    NONE = "none"
    """It is not."""
    NO_DATA = "no-data"
    """Nothing was measured yet, or for too long."""
    MOVED = "moved"
    """The patient is, or may be, out of tolerance."""
    SETTLING = "settling"
    """The patient is back, and not yet for long enough."""
    LATCHED = "latched"
    """The patient is back; somebody has to acknowledge what happened."""
    CLOCK = "clock"
    """Time went back."""


@dataclass(frozen=True)
class BeamHoldTiming:
    """When a hold begins and ends, whatever is measured.

    Args:
        max_gap_ns: longest time without a measurement before the beam is held [ns].
        settle_ns: how long all has to be within the release limits before the beam goes on [ns].
        latched: whether a hold, after the first release, lasts until it is acknowledged.
    """

    max_gap_ns: int = 100_000_000
    settle_ns: int = 500_000_000
    latched: bool = False

    def __post_init__(self) -> None:
        if self.max_gap_ns <= 0:
            raise InvalidParameter(f"max_gap_ns is {self.max_gap_ns}; it must be above 0")
        if self.settle_ns < 0:
            raise InvalidParameter(f"settle_ns is {self.settle_ns}; it must not be negative")


@dataclass(frozen=True)
class LimitCheck:
    """Result of one measurement against the limits.

    Args:
        beyond: what is, or may be, out of tolerance, in words; None: nothing.
        within: whether everything is within the release limits.
        time_ns: time of the oldest data that it needs [ns]; None: the present time.
    """

    beyond: str | None
    within: bool
    time_ns: int | None = None


@dataclass(frozen=True)
class GateState:
    """Whether the beam is held, and why.

    Args:
        hold: whether it is held.
        cause: why.
        reason: the cause in words; None while it is not held.
        since_ns: beginning of the present state, held or not [ns].
    """

    hold: bool
    cause: BeamHoldCause
    reason: str | None
    since_ns: int


class BeamHoldGate:
    """State machine of a hold: held initially, beyond a limit, and without valid data."""

    def __init__(self, rules: BeamHoldTiming, *, latched: bool = False) -> None:
        """Begin held.

        Args:
            rules: when holds begin and end.
            latched: whether the first hold lasts until it is acknowledged, as one that goes on
                from another gate's; whatever the rules say of later ones.
        """
        self._rules = rules
        self._time: int | None = None
        self._seen: int | None = None
        self._within_since: int | None = None
        self._released = False
        self._latched = latched
        self._state: GateState | None = None
        self._why = "nothing was measured yet"
        self._cause = BeamHoldCause.NO_DATA

    def step(self, time_ns: int, measured: LimitCheck | None) -> GateState:
        """Return the state at a time.

        Args:
            time_ns: the time [ns]; must not decrease.
            measured: result of the measurement; None: there is none at this time. Call it with None
                now and then while no measurements arrive, so that their absence is noticed.
        """
        back = self._time is not None and time_ns < self._time
        gap = None if self._seen is None else time_ns - self._seen
        self._time = time_ns
        if back:
            self._hold(BeamHoldCause.CLOCK, "the measurements' time went back")
            self._seen = None
        elif gap is not None and gap > self._rules.max_gap_ns:
            self._hold(
                BeamHoldCause.NO_DATA,
                f"nothing was measured for {gap * 1e-6:.0f} ms; at most "
                f"{self._rules.max_gap_ns * 1e-6:.0f} ms are allowed",
            )
        if measured is None:
            return self._current_state(time_ns, measured=False)
        since = time_ns if measured.time_ns is None else measured.time_ns
        if measured.beyond is None and time_ns - since > self._rules.max_gap_ns:
            # Older than the longest gap: it counts as no measurement.
            return self._current_state(time_ns, measured=False)
        self._seen = since if self._seen is None else max(since, self._seen)
        self._check_limits(time_ns, measured)
        return self._current_state(time_ns, measured=True)

    def fail(self, why: str) -> GateState:
        """Hold now: there are no measurements, or they are unusable.

        For failures that the times of the measurements do not show. The next measurement may have
        any time.

        Args:
            why: the reason in words.
        """
        time_ns = self.time_ns
        self._hold(BeamHoldCause.NO_DATA, why)
        self._time = self._seen = None
        return self._current_state(time_ns, measured=False)

    @property
    def time_ns(self) -> int:
        """Time of the last step on the measurements' clock [ns]; 0: none since start or failure."""
        return 0 if self._time is None else self._time

    @property
    def measured_ns(self) -> int | None:
        """Time of the oldest data that were needed last [measurements' clock, ns]; None: none."""
        return self._seen

    @property
    def must_acknowledge(self) -> bool:
        """Whether a successor of this gate must be acknowledged before it releases."""
        return self._latched or (self._rules.latched and self._released)

    def acknowledge(self) -> None:
        """End the latch; the hold ends once all is, and stays, within the release limits."""
        self._latched = False

    def _hold(self, cause: BeamHoldCause, why: str) -> None:
        self._cause, self._why = cause, why
        self._within_since = None
        self._latched = self._latched or (self._rules.latched and self._released)
        self._released = False

    def _check_limits(self, time_ns: int, measured: LimitCheck) -> None:
        if measured.beyond is not None:
            self._hold(BeamHoldCause.MOVED, measured.beyond)
        elif not measured.within:
            # Hysteresis: between release limit and limit the state stays as it is.
            self._within_since = None
        elif self._within_since is None:
            self._within_since = time_ns

    def _current_state(self, time_ns: int, *, measured: bool) -> GateState:
        since, settle = self._within_since, self._rules.settle_ns
        waited = None if since is None else time_ns - since
        if not self._released and waited is not None and waited >= settle and not self._latched:
            # Release only on a measurement, never because time passed.
            self._released = measured
        cause, reason = BeamHoldCause.NONE, None
        if not self._released:
            cause, reason = self._cause, self._why
            if waited is not None:
                cause = BeamHoldCause.LATCHED if self._latched else BeamHoldCause.SETTLING
                still = (
                    "back within limits; to be acknowledged"
                    if self._latched
                    else f"back within limits for {waited * 1e-6:.0f} of {settle * 1e-6:.0f} ms"
                )
                reason = f"{self._why}; {still}"
        before = self._state
        same = before is not None and before.hold != self._released
        since_ns = before.since_ns if before is not None and same else time_ns
        self._state = GateState(not self._released, cause, reason, since_ns)
        return self._state
