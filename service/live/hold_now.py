"""HoldNow: whether a beam is held now, and why; as the stream sends it."""

from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from compute.pose.hold import HoldState
from compute.pose.hold_gate import HoldCause

Vector = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class HoldNow:
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
        turn_rad: rotation vector from the reference [rad]; None: not measured, or of markers.
        chance: of being beyond the limit that is nearest to it.
    """

    hold_id: str
    held: bool
    cause: HoldCause
    reason: str | None
    since_ns: int
    exposure_ns: int | None = None
    sequence: int | None = None
    shift_mm: Vector | None = None
    turn_rad: Vector | None = None
    chance: float | None = None

    @classmethod
    def of(
        cls,
        hold_id: str,
        state: HoldState,
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
            _vector(state.turn_rad),
            state.chance,
        )

    def differs(self, other: "HoldNow | None") -> bool:
        """Whether clients are told: it is held, or for a cause, unlike before."""
        return other is None or (self.held, self.cause) != (other.held, other.cause)


def _vector(values: NDArray[np.float64] | None) -> Vector | None:
    if values is None:
        return None
    x, y, z = values.tolist()
    return x, y, z


def hold_part(now: HoldNow) -> dict[str, Any]:
    """Return a hold as frames and hello have it."""
    return {
        "hold": now.hold_id,
        "held": now.held,
        "cause": now.cause.value,
        "reason": now.reason,
        "since_ns": now.since_ns,
        "shift_mm": now.shift_mm,
        "turn_rad": now.turn_rad,
        "chance": now.chance,
    }


def hold_message(device_id: str, now: HoldNow) -> dict[str, Any]:
    """Return the message that tells of a change."""
    return {
        "type": "hold",
        "device": device_id,
        **hold_part(now),
        "exposure_ns": now.exposure_ns,
        "sequence": now.sequence,
    }
