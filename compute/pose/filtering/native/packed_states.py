"""States in the kernel's memory: poses and modes whose arrays are views, made when asked for."""

from functools import cached_property
from itertools import accumulate
from math import prod
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from compute.pose.centred_markers import CentredMarkers
from compute.pose.filtering.imm_model import IMM_STATES, ImmModel
from compute.pose.filtering.imm_state import ImmState
from compute.pose.filtering.native.kernel_arguments import FIGURES, FIGURES_SIZE, POSE
from compute.pose.filtering.pose_filter import STATES, PoseState, ReportedPose

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
        covariances: int,
        row: int,
        common_errors: int,
        known: tuple[CentredMarkers, Array] | None = None,
    ) -> "PackedPose":
        """Return that of an instant [ns].

        Args:
            time_ns: the instant [ns].
            block: rotation, centroid, velocity and turn rate come first in it.
            covariances: index of the covariance and that with the common errors, row by row.
            row: from one row of the covariance to the next; 0: the one with the errors lies behind
                it, else beside it, after the accelerations.
            common_errors: number of common errors.
            known: what is reported of it as a tool with these markers, one after another, in memory
                that it has for itself; None: that is not worked out yet.
        """
        made = object.__new__(cls)
        made.__dict__.update(
            time_ns=time_ns, _block=block, _at=(covariances, row, common_errors), _known=known
        )
        return made

    def reported_pose(self, centred: CentredMarkers) -> ReportedPose:
        """As of PoseState."""
        known = self.__dict__["_known"]
        if known is None or known[0] is not centred:
            return super().reported_pose(centred)
        return ReportedPose(
            *(known[1][first:last].reshape(shape) for first, last, shape in _PLACES)
        )

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
    def angular_velocity_rad_s(self) -> Array:
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
        first, row, common_errors = self.__dict__["_at"]
        if row:
            return self._view((STATES, row), first)[:, IMM_STATES:]
        return self._view((STATES, common_errors), first + STATES * STATES)


class PackedImmState(ImmState):
    """ImmState in a block of memory, which nobody writes to any more."""

    @classmethod
    def within(
        cls,
        model: ImmModel,
        time_ns: int,
        block: Array,
        common_errors: int,
        combined: PoseState | None = None,
    ) -> "PackedImmState":
        """Return those of an instant [ns].

        Args:
            model: how the state changes under each.
            time_ns: the instant [ns].
            block: as of ``ImmState.packed``.
            common_errors: number of common errors.
            combined: the state of all together, if it is known.
        """
        made = object.__new__(cls)
        known: dict[str, Any] = {"model": model, "packed": block, "_at": (time_ns, common_errors)}
        if combined is not None:
            known["combined"] = combined
        made.__dict__.update(known)
        return made

    @property
    def _first(self) -> int:
        """Where the offsets begin: behind the pose and the chances."""
        return POSE + len(self.model)

    @cached_property
    def widest_state(self) -> PoseState:
        """As of ImmState."""
        time_ns, common_errors = self.__dict__["_at"]
        count, wide = len(self.model), IMM_STATES + common_errors
        last = self._first + count * IMM_STATES + (count - 1) * IMM_STATES * wide
        return PackedPose.within(time_ns, self.packed, last, wide, common_errors)

    @cached_property
    def offsets(self) -> Array:
        """As of ImmState."""
        first, size = self._first, len(self.model) * IMM_STATES
        return self.packed[first : first + size].reshape(-1, IMM_STATES)

    @cached_property
    def covariances(self) -> Array:
        """As of ImmState."""
        count, (_, common_errors) = len(self.model), self.__dict__["_at"]
        first = self._first + count * IMM_STATES
        size = count * IMM_STATES * (IMM_STATES + common_errors)
        return self.packed[first : first + size].reshape(count, IMM_STATES, -1)

    @cached_property
    def mode_probabilities(self) -> Array:
        """As of ImmState."""
        return self.packed[POSE : self._first]
