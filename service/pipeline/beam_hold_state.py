"""BeamHoldState: whether a beam is held now, and why; as the stream sends it."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from compute.pose.beam_hold.beam_hold_monitor import BeamHoldDecision
from compute.pose.beam_hold.beam_hold_state import BeamHoldCause

Vector = tuple[float, float, float]


class BeamEnableToken:
    """A time during which a beam is not held: all that says so while it lasts has the same one.

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
        """End it; ``by``: the hold that does."""
        self._ended = by

    @property
    def over(self) -> bool:
        """Whether the beam is held since."""
        return self._ended is not None or self._monotonic_s() >= self.due_s

    @property
    def ended(self) -> "BeamHoldState | None":
        """The hold that ended it; None: none did, though its deadline may have passed."""
        return self._ended


@dataclass(frozen=True, slots=True)
class BeamHoldState:
    """A hold after a frame, or after what happened between two.

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
        """Whether it says that the beam is not held, and the beam was held since."""
        return not self.held and self.release is not None and self.release.over

    @property
    def standing(self) -> "BeamHoldState":
        """The same as it is to be told now: held, where the beam was held since."""
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
        """Return what a monitor says at a frame."""
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
        """Whether clients are told: it is held, or for a cause, unlike before."""
        return other is None or (self.held, self.cause) != (other.held, other.cause)


def _vector(values: NDArray[np.float64] | None) -> Vector | None:
    if values is None:
        return None
    x, y, z = values.tolist()
    return x, y, z


def hold_part(now: BeamHoldState) -> dict[str, Any]:
    """Return a hold as frames and hello have it: held, where it was held since."""
    now = now.standing
    return {
        "hold": now.hold_id,
        "held": now.held,
        "cause": now.cause.value,
        "reason": now.reason,
        "since_ns": now.since_ns,
        "shift_mm": now.shift_mm,
        "rotation_rad": now.rotation_rad,
        "probability": now.probability,
    }


class BeamHoldMessage(dict[str, Any]):
    """The message that tells of a change; ``sent`` says it as it is when it is sent."""

    def __init__(self, device_id: str, now: BeamHoldState) -> None:
        super().__init__(
            {
                "type": "hold",
                "device": device_id,
                **hold_part(now),
                "exposure_ns": now.exposure_ns,
                "sequence": now.sequence,
            }
        )
        self.now = now

    @property
    def sent(self) -> dict[str, Any]:
        """Its members, held where the beam was held since it was told."""
        return {**self, **hold_part(self.now)}
