"""States in the kernel's memory: poses and regimes whose arrays are views, made when asked for."""

from functools import cached_property
from itertools import accumulate
from math import prod
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from compute.pose.marker_frame import MarkerFrame
from compute.pose.native.record import FIGURES, FIGURES_SIZE, POSE
from compute.pose.pose_filter import STATES, PoseFigures, PoseState
from compute.pose.regime_model import MOVING, RegimeModel
from compute.pose.regimes import Regimes

Array = NDArray[np.float64]

_ENDS: Final = tuple(accumulate(prod(shape) for shape in FIGURES.values()))
_PLACES: Final = tuple(zip((0, *_ENDS), _ENDS, FIGURES.values(), strict=False))
assert _ENDS[-1] == FIGURES_SIZE


class PackedPose(PoseState):
    """A PoseState in a block of memory, which nobody writes to any more."""

    @classmethod
    def within(
        cls,
        time_ns: int,
        block: Array,
        spread: int,
        row: int,
        errors: int,
        known: tuple[MarkerFrame, Array] | None = None,
    ) -> "PackedPose":
        """Return that of an instant [ns].

        Args:
            time_ns: the instant [ns].
            block: rotation, centroid, velocity and turn rate come first in it.
            spread: index of the covariance and that with the common errors, row by row.
            row: from one row of the covariance to the next; 0: the one with the errors lies behind
                it, else beside it, after the accelerations.
            errors: number of common errors.
            known: what is reported of it as a tool with these markers, one after another, in memory
                that it has for itself; None: that is not worked out yet.
        """
        made = object.__new__(cls)
        made.__dict__.update(time_ns=time_ns, _block=block, _at=(spread, row, errors), _known=known)
        return made

    def figures(self, frame: MarkerFrame) -> PoseFigures:
        """As of PoseState."""
        known = self.__dict__["_known"]
        if known is None or known[0] is not frame:
            return super().figures(frame)
        return PoseFigures(*(known[1][first:last].reshape(shape) for first, last, shape in _PLACES))

    def _view(self, shape: tuple[int, ...], first: int) -> Array:
        return np.ndarray(shape, np.float64, self.__dict__["_block"], 8 * first)

    @cached_property
    def rotation(self) -> Array:
        """As of PoseState."""
        return self._view((3, 3), 0)

    @cached_property
    def centroid_mm(self) -> Array:
        """As of PoseState."""
        return self._view((3,), 9)

    @cached_property
    def velocity_mm_s(self) -> Array:
        """As of PoseState."""
        return self._view((3,), 12)

    @cached_property
    def turn_rate_rad_s(self) -> Array:
        """As of PoseState."""
        return self._view((3,), 15)

    @cached_property
    def covariance(self) -> Array:
        """As of PoseState."""
        first, row, _ = self.__dict__["_at"]
        return self._view((STATES, row or STATES), first)[:, :STATES]

    @cached_property
    def common(self) -> Array:
        """As of PoseState."""
        first, row, errors = self.__dict__["_at"]
        if row:
            return self._view((STATES, row), first)[:, MOVING:]
        return self._view((STATES, errors), first + STATES * STATES)


class PackedRegimes(Regimes):
    """Regimes in a block of memory, which nobody writes to any more."""

    @classmethod
    def within(
        cls,
        model: RegimeModel,
        time_ns: int,
        block: Array,
        errors: int,
        whole: PoseState | None = None,
    ) -> "PackedRegimes":
        """Return those of an instant [ns].

        Args:
            model: how the state changes under each.
            time_ns: the instant [ns].
            block: as of ``Regimes.packed``.
            errors: number of common errors.
            whole: the state of all together, if it is known.
        """
        made = object.__new__(cls)
        known: dict[str, Any] = {"model": model, "packed": block, "_at": (time_ns, errors)}
        if whole is not None:
            known["whole"] = whole
        made.__dict__.update(known)
        return made

    @property
    def _first(self) -> int:
        """Where the offsets begin: behind the pose and the chances."""
        return POSE + len(self.model)

    @cached_property
    def widest(self) -> PoseState:
        """As of Regimes."""
        time_ns, errors = self.__dict__["_at"]
        count, wide = len(self.model), MOVING + errors
        last = self._first + count * MOVING + (count - 1) * MOVING * wide
        return PackedPose.within(time_ns, self.packed, last, wide, errors)

    @cached_property
    def off(self) -> Array:
        """As of Regimes."""
        first, size = self._first, len(self.model) * MOVING
        return self.packed[first : first + size].reshape(-1, MOVING)

    @cached_property
    def spread(self) -> Array:
        """As of Regimes."""
        count, (_, errors) = len(self.model), self.__dict__["_at"]
        first = self._first + count * MOVING
        size = count * MOVING * (MOVING + errors)
        return self.packed[first : first + size].reshape(count, MOVING, -1)

    @cached_property
    def chance(self) -> Array:
        """As of Regimes."""
        return self.packed[POSE : self._first]
