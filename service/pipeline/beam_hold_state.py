"""BeamHoldState: whether a beam is held after a frame, and why; BeamEnableToken."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from compute.pose.beam_hold import BeamHoldCause, BeamHoldDecision

Vector = tuple[float, float, float]


class BeamEnableToken:
    """Validity of "the beam is enabled": shared by all states that say so, ended by the next hold.

    Once it is over, whatever said that the beam may go on says so no more, however long it waits
    until it is sent. Ended by whoever holds the beam, and by itself at its deadline.

    Args:
        monotonic_s: a clock that does not go back [s].
    """

    __slots__ = ("_ended", "_monotonic_s", "due_s")

    def __init__(self, monotonic_s: Callable[[], float]) -> None:
        self._monotonic_s = monotonic_s
        self._ended: BeamHoldState | None = None
        self.due_s = -math.inf
        """When its newest measurement is too old, by that clock [s]."""

    def end(self, by: "BeamHoldState") -> None:
        """End it; ``by`` is the state that holds the beam."""
        self._ended = by

    @property
    def over(self) -> bool:
        """Whether the beam was held since, or the deadline has passed."""
        return self._ended is not None or self._monotonic_s() >= self.due_s

    @property
    def ended(self) -> "BeamHoldState | None":
        """The state that ended it; None: none did, though its deadline may have passed."""
        return self._ended


@dataclass(frozen=True, slots=True)
class BeamHoldState:
    """State of a beam hold after a frame, or after an event between two frames.

    Args:
        hold_id: the hold.
        held: whether the beam is held.
        cause: why.
        reason: the same for a person; None while it is not held.
        since_ns: when it began to be, or not to be, held, on the host's clock [ns].
        exposure_ns: middle of the exposure of the newest frame that was looked at, on the host's
            clock [ns]; None: none was yet.
        sequence: number of that frame.
        shift_mm: of the target, or of the marker that is nearest to its limit [mm]; None: not
            measured in this frame.
        rotation_rad: rotation vector from the reference [rad]; None: not measured, or of markers.
        probability: of being beyond the limit that is nearest to it.
        release: while it is not held: what says whether that is still so.
    """

    hold_id: str
    held: bool
    cause: BeamHoldCause
    reason: str | None
    since_ns: int
    exposure_ns: int | None = None
    sequence: int | None = None
    shift_mm: Vector | None = None
    rotation_rad: Vector | None = None
    probability: float | None = None
    release: BeamEnableToken | None = field(default=None, compare=False, repr=False)

    @property
    def superseded(self) -> bool:
        """Whether it says "enabled", and the beam was held since."""
        return not self.held and self.release is not None and self.release.over

    @property
    def standing(self) -> "BeamHoldState":
        """The state as it is to be reported now: held, where the beam was held since."""
        if not self.superseded:
            return self
        assert self.release is not None
        by = self.release.ended
        if by is None:
            why = "nothing was measured since for longer than is allowed"
            return replace(self, held=True, cause=BeamHoldCause.NO_DATA, reason=why, release=None)
        return replace(
            self, held=True, cause=by.cause, reason=by.reason, since_ns=by.since_ns, release=None
        )

    @classmethod
    def of(
        cls,
        hold_id: str,
        state: BeamHoldDecision,
        reason: str | None,
        since_ns: int,
        exposure_ns: int | None,
        sequence: int | None,
    ) -> Self:
        """Return the state for a monitor's decision at a frame."""
        return cls(
            hold_id,
            state.hold,
            state.cause,
            reason,
            since_ns,
            exposure_ns,
            sequence,
            _vector(state.shift_mm),
            _vector(state.rotation_rad),
            state.probability,
        )

    def differs(self, other: "BeamHoldState | None") -> bool:
        """Whether ``held`` or the cause differ, so that clients are told."""
        return other is None or (self.held, self.cause) != (other.held, other.cause)


def _vector(values: NDArray[np.float64] | None) -> Vector | None:
    if values is None:
        return None
    x, y, z = values.tolist()
    return x, y, z
