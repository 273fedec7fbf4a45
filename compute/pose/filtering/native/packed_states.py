"""PackedPose, PackedImmState: states whose arrays are views of the memory that a kernel writes."""

from itertools import accumulate
from math import prod
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from compute.pose.filtering.imm import IMM_STATES, ImmModel, ImmState
from compute.pose.filtering.native.definitions import POSE
from compute.pose.filtering.pose_filter import STATES, PoseState, ReportedPose
from compute.pose.rigid_body import CentredMarkers

Array = NDArray[np.float64]

_POSE_VIEWS: Final[dict[str, tuple[tuple[int, ...], int]]] = {
    "rotation": ((3, 3), 0),
    "centroid_mm": ((3,), 9),
    "velocity_mm_s": ((3,), 12),
    "angular_velocity_rad_s": ((3,), 15),
}
"""Members of PoseState: shape, and offset in memory."""
_REPORTED_SHAPES: Final = ((3, 3), (3,), (3,), (6, 6), (3,), (3, 3), (3,))
"""Shapes of the arrays of ReportedPose, in their order in memory; its numbers follow."""
_ENDS: Final = tuple(accumulate(map(prod, _REPORTED_SHAPES)))
_REPORTED_VIEWS: Final = tuple(
    (8 * first, shape) for first, shape in zip((0, *_ENDS), _REPORTED_SHAPES, strict=False)
)
REPORTED_SIZE: Final = _ENDS[-1] + 2
"""Number of float64 of a ReportedPose."""


class PackedPose(PoseState):
    """PoseState whose arrays are views, made at first use, of memory that stays as it is."""

    @classmethod
    def within(
        cls,
        time_ns: int,
        block: Array,
        covariances: int,
        row: int,
        common_errors: int,
        reported: tuple[CentredMarkers, Array] | None = None,
    ) -> "PackedPose":
        """Return the state in a block of memory.

        Args:
            time_ns: time of the state [ns].
            block: memory that begins with rotation, centroid, velocity and angular velocity.
            covariances: index of the covariances in the block, row by row.
            row: length of a row of the covariances, which then also has the columns of
                accelerations and common errors; 0: the covariance with the common errors follows
                the state's.
            common_errors: number of common errors.
            reported: the markers and the values of the reported pose, in the order of its members;
                None: not computed yet.
        """
        state = object.__new__(cls)
        members = state.__dict__
        members["time_ns"], members["_block"], members["_reported"] = time_ns, block, reported
        members["_at"] = covariances, row, common_errors
        return state

    def __getattr__(self, name: str) -> Array:
        """Return a member of PoseState, and keep it.

        Raises:
            AttributeError: PoseState has no such member.
        """
        if name not in PoseState.__dataclass_fields__:
            raise AttributeError(name)
        first, row, common_errors = self.__dict__["_at"]
        if name in _POSE_VIEWS:
            view = self._view(*_POSE_VIEWS[name])
        elif name == "covariance":
            view = self._view((STATES, row or STATES), first)[:, :STATES]
        elif row:
            view = self._view((STATES, row), first)[:, IMM_STATES:]
        else:
            view = self._view((STATES, common_errors), first + STATES * STATES)
        self.__dict__[name] = view
        return view

    def _view(self, shape: tuple[int, ...], first: int) -> Array:
        return np.ndarray(shape, np.float64, self.__dict__["_block"], 8 * first)

    def reported_pose(self, centred: CentredMarkers) -> ReportedPose:
        """Return the reported pose, by the kernel where its values are of these markers."""
        reported = self.__dict__["_reported"]
        if reported is None or reported[0] is not centred:
            return super().reported_pose(centred)
        values = reported[1]
        rotation, rate, translation, covariance, tip, tip_covariance, velocity = [
            np.ndarray(shape, np.float64, values, first) for first, shape in _REPORTED_VIEWS
        ]
        tip_variance, pose_variance = values[_ENDS[-1] :].tolist()
        return ReportedPose(
            rotation,
            rate,
            translation,
            covariance,
            tip,
            tip_covariance,
            velocity,
            tip_variance,
            pose_variance,
        )


class PackedImmState(ImmState):
    """ImmState whose arrays are views, made at first use, of memory that stays as it is."""

    @classmethod
    def within(
        cls,
        model: ImmModel,
        time_ns: int,
        block: Array,
        packed_address: int,
        common_errors: int,
        combined: PoseState | None = None,
    ) -> "PackedImmState":
        """Return the states in a block of memory.

        Args:
            model: the motion models.
            time_ns: time of the states [ns].
            block: memory in the order of ``ImmState.packed``.
            packed_address: its address.
            common_errors: number of common errors.
            combined: the combined state, if known.
        """
        state = object.__new__(cls)
        members = state.__dict__
        members["model"], members["packed"], members["packed_address"] = (
            model,
            block,
            packed_address,
        )
        members["_at"] = time_ns, common_errors
        if combined is not None:
            members["combined"] = combined
        return state

    def __getattr__(self, name: str) -> Any:
        """Return a member of ImmState, and keep it.

        Raises:
            AttributeError: ImmState has no such member.
        """
        if name not in ImmState.__dataclass_fields__:
            raise AttributeError(name)
        time_ns, common_errors = self.__dict__["_at"]
        count, wide = len(self.model), IMM_STATES + common_errors
        offsets = POSE + count
        covariances = offsets + count * IMM_STATES
        member: object
        if name == "widest_state":
            last = covariances + (count - 1) * IMM_STATES * wide
            member = PackedPose.within(time_ns, self.packed, last, wide, common_errors)
        elif name == "offsets":
            member = self.packed[offsets:covariances].reshape(count, IMM_STATES)
        elif name == "covariances":
            member = self.packed[covariances:].reshape(count, IMM_STATES, wide)
        else:
            member = self.packed[POSE:offsets]
        self.__dict__[name] = member
        return member
