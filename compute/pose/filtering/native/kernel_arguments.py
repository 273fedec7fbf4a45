"""Memory of the strobed-step kernel: its argument record, sizes, and states as views of it."""

from functools import cached_property
from itertools import accumulate
from math import prod
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from compute.native.records import Record
from compute.pose.filtering.imm_model import IMM_STATES, ImmModel
from compute.pose.filtering.imm_state import ImmState
from compute.pose.filtering.pose_filter import STATES, PoseState, ReportedPose
from compute.pose.rigid_body import CentredMarkers
from compute.reconstruction.native.definitions import CAMERAS

_OF_FRAMES: Final = {
    # States before, predicted and after, results and reported pose; then the frame's peaks,
    # (S, P).
    "before": "const double*",
    "predicted": "double*",
    "after": "double*",
    "result": "double*",
    "reported_pose": "double*",
    "position": "const double*",
    "variance": "const double*",
    "usable": "const unsigned char*",
    # Number of peaks of each sensor, and the lit marker; -1: none, prediction only.
    "peaks": "long long",
    "lit": "long long",
}
_NUMBERS_OF_FRAMES: Final = {
    "time_s": "double",
    "switch_probability": "double",
    "manoeuvre_factor": "double",
}
_OF_TOOLS: Final[dict[str, str | Record]] = {
    # Covariance factor of the calibration, (S, width, C).
    "columns": "const double*",
    # Motion models: (K, 18), (K, 18, 18), (K,), (5, K * 18 * 18).
    "persistence": "const double*",
    "initial_covariance": "const double*",
    "renewal": "const double*",
    "terms": "const double*",
    # (M, 3) relative to the centroid; (S + 1,), by number of readings; scratch memory.
    "markers": "const double*",
    "chi2_limits": "const double*",
    "scratch": "double*",
    "modes": "long long",
    "errors": "long long",
    "own_errors": "long long",
    "gate": "double",
    "radius_mm": "double",
    "principal_distance_px": "double",
    # The centroid in the tool's coordinates and the tip less it.
    "centroid": "double[3]",
    "tip": "double[3]",
    "cameras": CAMERAS,
}

STEP_RECORD: Final = Record("StepRecord", {**_OF_FRAMES, **_NUMBERS_OF_FRAMES, **_OF_TOOLS})
"""Argument record of one step of one tool; 64-bit words only. Members that change from frame to
frame come first."""
STEP: Final = STEP_RECORD.dtype
FRAME_WORDS: Final = len(_OF_FRAMES)
"""Number of addresses and counts of a frame; its numbers follow."""
FRAME_NUMBERS: Final = len(_NUMBERS_OF_FRAMES)

POSE: Final = 18
"""Number of values of rotation, centroid, velocity and angular velocity. In an ImmState the mode
probabilities, offsets and covariances follow."""
FIGURES: Final = {
    "rotation": (3, 3),
    "angular_velocity_rad_s": (3,),
    "translation_mm": (3,),
    "covariance": (6, 6),
    "tip_mm": (3,),
    "tip_covariance_mm2": (3, 3),
    "velocity_mm_s": (3,),
}
"""Members of ReportedPose in their order in memory."""
FIGURES_SIZE: Final = 66
HEAD: Final = 4
"""Number of values at the head of a result: outcome, number of readings, their NIS, and that of the
widest model."""

TAKEN: Final = 0
"""Readings were used, or there were none within the gates."""
CURVED: Final = 1
"""Second-order terms matter, or the covariance has no Cholesky factor: only the prediction is
set."""
CONTESTED: Final = 2
"""A sensor has several peaks within the gate: only the prediction is set."""
MISFIT: Final = 3
"""The readings do not fit one another: only the prediction is set."""


def imm_state_size(imm: int, errors: int) -> int:
    """Return the number of float64 of an ImmState.

    Args:
        imm: number K of motion models.
        errors: number E of common errors.
    """
    return POSE + imm * (1 + IMM_STATES + IMM_STATES * (IMM_STATES + errors))


def result_size(sensors: int, errors: int) -> int:
    """Return the number of float64 of a result.

    A result holds the head; the index of each sensor's peak, -1: none; the combined state; the
    whitened innovations, (n, 1 + E).

    Args:
        sensors: number of sensors.
        errors: number E of common errors.
    """
    return HEAD + sensors + POSE + 144 + 12 * errors + sensors * (1 + errors)


def scratch_size(sensors: int, imm: int, errors: int) -> int:
    """Return the number of float64 of the kernel's scratch memory.

    Args:
        sensors: number of sensors.
        imm: number K of motion models.
        errors: number E of common errors.
    """
    wide = IMM_STATES + errors
    mixing = imm * imm + IMM_STATES * IMM_STATES + IMM_STATES
    readings = sensors * (errors + wide) + imm * (sensors * (1 + wide) + 2)
    return mixing + readings + IMM_STATES * wide


Array = NDArray[np.float64]

_ENDS: Final = tuple(accumulate(prod(shape) for shape in FIGURES.values()))
_PLACES: Final = tuple(zip((0, *_ENDS), _ENDS, FIGURES.values(), strict=False))
assert _ENDS[-1] == FIGURES_SIZE


class PackedPose(PoseState):
    """PoseState whose arrays are views of a block of memory that is no longer written to."""

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
        """Return the state in a block of memory.

        Args:
            time_ns: time of the state [ns].
            block: memory that begins with rotation, centroid, velocity and angular velocity.
            covariances: index of the covariances in the block, row by row.
            row: length of a row of the covariances, which then also has the columns of
                accelerations and common errors; 0: the covariance with the common errors follows
                the state's.
            common_errors: number of common errors.
            known: the markers and the values of the reported pose, in the order of FIGURES; None:
                not computed yet.
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
    """ImmState whose arrays are views of a block of memory that is no longer written to."""

    @classmethod
    def within(
        cls,
        model: ImmModel,
        time_ns: int,
        block: Array,
        common_errors: int,
        combined: PoseState | None = None,
    ) -> "PackedImmState":
        """Return the states in a block of memory.

        Args:
            model: the motion models.
            time_ns: time of the states [ns].
            block: memory in the order of ``ImmState.packed``.
            common_errors: number of common errors.
            combined: the combined state, if known.
        """
        made = object.__new__(cls)
        known: dict[str, Any] = {"model": model, "packed": block, "_at": (time_ns, common_errors)}
        if combined is not None:
            known["combined"] = combined
        made.__dict__.update(known)
        return made

    @property
    def _first(self) -> int:
        """Index of the offsets: behind the pose and the mode probabilities."""
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
