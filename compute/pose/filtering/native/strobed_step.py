"""StrobedStepKernel: prediction, gating and update of a strobed tool in one launch."""

from dataclasses import dataclass
from functools import cache, lru_cache
from itertools import accumulate
from math import prod
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from compute.measurement.measurement_model import MeasurementModel
from compute.pose.filtering.imm import IMM_STATES, ImmModel, ImmState
from compute.pose.filtering.native.definitions import (
    FRAME_NUMBERS,
    FRAME_WORDS,
    HEAD,
    MISFIT,
    POSE,
    STEP,
    UPDATED,
)
from compute.pose.filtering.pose_filter import STATES, PoseState, ReportedPose
from compute.pose.rigid_body import CentredMarkers
from compute.reconstruction.native.definitions import MAX_POWER, fill_cameras, row_length
from compute.reconstruction.solver import MAX_SENSORS, MIN_CAPACITY, term_capacity
from compute.reconstruction.triangulation import chi2_limit
from compute.warp_host import PackedLaunch, address

if TYPE_CHECKING:
    from compute.measurement.measurements import Measurements

Array = NDArray[np.float64]

_NONE_LIT: Final = 2**64 - 1
"""-1, as the unsigned words that a record is written in."""
_POSE_VIEWS: Final[dict[str, tuple[tuple[int, ...], int]]] = {
    "rotation": ((3, 3), 0),
    "centroid_mm": ((3,), 9),
    "velocity_mm_s": ((3,), 12),
    "angular_velocity_rad_s": ((3,), 15),
}
"""Members of PoseState: shape, and offset in memory."""
_REPORTED_SHAPES: Final = ((3, 3), (3,), (3,), (6, 6), (3,), (3, 3), (3,))
"""Shapes of the members of ReportedPose, in their order in memory."""
_ENDS: Final = tuple(accumulate(map(prod, _REPORTED_SHAPES)))
_REPORTED_VIEWS: Final = tuple(zip((0, *_ENDS), _ENDS, _REPORTED_SHAPES, strict=False))


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
        state.__dict__.update(
            time_ns=time_ns, _block=block, _at=(covariances, row, common_errors), _reported=reported
        )
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
        return ReportedPose(
            *(reported[1][first:last].reshape(shape) for first, last, shape in _REPORTED_VIEWS)
        )


class PackedImmState(ImmState):
    """ImmState whose arrays are views, made at first use, of memory that stays as it is."""

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
        state = object.__new__(cls)
        members: dict[str, Any] = {"model": model, "packed": block, "_at": (time_ns, common_errors)}
        if combined is not None:
            members["combined"] = combined
        state.__dict__.update(members)
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


@dataclass(frozen=True, eq=False)
class Step:
    """A tool after an exposure.

    Args:
        predicted: predicted states at the exposure.
        imm: updated states; None: the readings are not unambiguous, none was used.
        peaks: index of each sensor's peak, -1: none, shape (1, S).
        readings: number of readings that were used.
        nis: their normalised innovation squared.
        misfit: readings within the gates do not fit one another: none was used.
        excluded: normalised squares of peaks that are near and were not used, as
            ``ToolObservation.excluded_nis``, shape (1, S).
        whitened: their whitened innovations and Jacobian, as in ImmUpdate, shape (n, 1 + E).
    """

    predicted: ImmState
    imm: ImmState | None
    peaks: NDArray[np.intp]
    readings: int
    nis: float
    misfit: bool
    excluded: Array
    whitened: Array


class StrobedStepKernel:
    """ImmState and ``associate`` for one lit marker with unambiguous readings, in one launch.

    They are unambiguous where each sensor has at most one peak within the marker's gate. Otherwise
    no reading is used, and the caller associates step by step.

    Warp is not thread-safe: the thread that makes the kernel calls it. Making it loads Warp, and
    compiles the kernel for this number of sensors unless an earlier process has (seconds).

    Args:
        model: the cameras; ``has_kernel`` must be true of them.
        imm: the motion models.
        centred: the tool's markers.
        common_errors: number of common errors of its filter.
        gate_probability: probability that a correct reading is outside the gate.
    """

    def __init__(
        self,
        model: MeasurementModel,
        imm: ImmModel,
        centred: CentredMarkers,
        common_errors: int,
        gate_probability: float,
    ) -> None:
        self._imm_model, self._centred = imm, centred
        self._common_errors = common_errors
        self._sensors = sensors = len(model)
        self._size = imm_state_size(len(imm), common_errors)
        self._result_size = result_size(sensors, common_errors)
        self._inputs: dict[int, tuple[Array, Array, NDArray[np.bool_], tuple[int, int, int]]] = {}
        self._switch_probability = lru_cache(maxsize=1)(imm.switch_probability)
        step = np.zeros(1, dtype=STEP)
        columns = model.covariance_factor * model.cameras.parameter_mask[..., None]
        limits = [chi2_limit(count, gate_probability) for count in range(sensors + 1)]
        # Kept alive: the records hold their addresses.
        self._buffers: list[Any] = [step]
        for name, values in (
            ("columns", columns),
            ("persistence", imm.state_mask),
            ("initial_covariance", imm.initial_covariance),
            ("renewal", imm.constant_velocity),
            ("terms", imm.noise_terms),
            ("markers", centred.markers_mm),
            ("chi2_limits", np.array(limits)),
            ("scratch", np.empty(scratch_size(sensors, len(imm), common_errors))),
        ):
            step[name] = self._keep(values)
        row = row_length(sensors, cuda=False)
        fill_cameras(step["cameras"], self._keep, model.cameras, model.corrections, row)
        for name, value in (
            ("modes", len(imm)),
            ("errors", common_errors),
            ("calibration_errors", columns.shape[2]),
            ("gate", chi2_limit(1, gate_probability)),
            ("radius_mm", centred.radius_mm),
            ("principal_distance_px", model.cameras.principal_distance_px.min()),
            ("centroid", centred.centroid_mm),
            ("tip", centred.tip_mm),
        ):
            step[name] = value
        self._words = step.view(np.uint64)[:FRAME_WORDS]
        self._numbers = step.view(np.float64)[FRAME_WORDS : FRAME_WORDS + FRAME_NUMBERS]
        kernel = step_kernel(sensors, term_capacity(model.cameras))
        self._launch = PackedLaunch.of_record(kernel, step)

    def take(
        self,
        before: ImmState,
        time_ns: int,
        lit: int,
        measurements: "Measurements",
        manoeuvre_factor: float = 1.0,
    ) -> Step:
        """Return the step to an exposure.

        Args:
            before: the states at the tool's last exposure.
            time_ns: time of this exposure, not earlier [ns].
            lit: index of the marker that it lights.
            measurements: the frame's peaks.
            manoeuvre_factor: factor on the accelerations of all models.
        """
        size, sensors, common_errors = self._size, self._sensors, self._common_errors
        block, reported_pose = np.empty(2 * size + self._result_size), np.empty(_ENDS[-1])
        first = address(block)
        peaks_each = measurements.position_px.shape[1]
        position, variance, usable, at = self._input_arrays(peaks_each)
        position[:] = measurements.position_px
        variance[:] = measurements.variance_px2
        usable[:] = measurements.usable
        self._words[:] = (
            before.packed_address,
            first,
            first + 8 * size,
            first + 16 * size,
            address(reported_pose),
            *at,
            peaks_each,
            lit,
        )
        self._run(before, time_ns, manoeuvre_factor)
        after = 2 * size
        outcome, count, nis = block[after : after + HEAD].tolist()
        peak = after + HEAD
        excluded, mixture = peak + sensors, peak + 2 * sensors
        peaks = block[peak:excluded].astype(np.intp)[None]
        readings, known = int(count), outcome in (UPDATED, MISFIT)
        combined = None
        if known:
            combined = PackedPose.within(
                time_ns, block[mixture:], POSE, 0, common_errors, (self._centred, reported_pose)
            )
        predicted = PackedImmState.within(
            self._imm_model,
            time_ns,
            block[:size],
            common_errors,
            None if readings else combined,
        )
        imm = predicted
        if readings:
            imm = PackedImmState.within(
                self._imm_model, time_ns, block[size:after], common_errors, combined
            )
        white = mixture + POSE + STATES * (STATES + common_errors)
        return Step(
            predicted,
            imm if known else None,
            peaks,
            readings,
            nis,
            outcome == MISFIT,
            block[None, excluded:mixture],
            # A copy: it is kept for some exposures, the rest of the block is not.
            block[white : white + readings * (1 + common_errors)]
            .reshape(readings, 1 + common_errors)
            .copy(),
        )

    def predict_combined(self, before: ImmState, time_ns: int) -> PoseState:
        """Return the combined state predicted to a time, as ``ImmState.predict_combined``.

        Args:
            before: the states at the tool's last exposure.
            time_ns: the time, not earlier [ns].
        """
        if time_ns == before.widest_state.time_ns:
            return before.combined
        block, reported_pose = np.empty(self._result_size), np.empty(_ENDS[-1])
        no_inputs = (0, 0, 0, 0)
        self._words[:] = (
            before.packed_address,
            0,
            0,
            address(block),
            address(reported_pose),
            *no_inputs,
            _NONE_LIT,
        )
        self._run(before, time_ns, 1.0)
        mixture = block[HEAD + 2 * self._sensors :]
        return PackedPose.within(
            time_ns, mixture, POSE, 0, self._common_errors, (self._centred, reported_pose)
        )

    def _run(self, before: ImmState, time_ns: int, manoeuvre_factor: float) -> None:
        step_s = 1e-9 * (time_ns - before.widest_state.time_ns)
        self._numbers[:] = step_s, self._switch_probability(step_s), manoeuvre_factor
        self._launch.run()

    def _keep(self, values: NDArray[Any]) -> int:
        array = np.ascontiguousarray(values)
        self._buffers.append(array)
        return address(array)

    def _input_arrays(
        self, peaks: int
    ) -> tuple[Array, Array, NDArray[np.bool_], tuple[int, int, int]]:
        """Return input arrays for a number of peaks per sensor, and their addresses."""
        if peaks not in self._inputs:
            shape = self._sensors, peaks
            position, variance = np.empty(shape), np.empty(shape)
            usable = np.empty(shape, dtype=np.bool_)
            at = address(position), address(variance), address(usable)
            self._inputs[peaks] = position, variance, usable, at
        return self._inputs[peaks]


@cache
def step_kernel(sensors: int, capacity: int) -> Any:
    """Return the strobed-step kernel; it takes the address of a STEP.

    Loads Warp. Launch it with one thread, on the CPU.

    Args:
        sensors: number of sensors.
        capacity: largest number of distortion terms.
    """
    from compute.native.native_kernel import native_kernel

    return native_kernel(
        "compute/pose/filtering/native/strobed_step.h",
        f"lumiline::pose::take_step<{sensors}, {capacity}>(address);",
    )


def has_kernel(model: MeasurementModel, imm: ImmModel) -> bool:
    """Return whether there is a kernel for these cameras and motion models.

    Args:
        model: the cameras.
        imm: the motion models.
    """
    cameras = model.cameras
    powers = max((max(term) for term in cameras.terms), default=0)
    return len(imm) > 1 and 1 <= len(cameras) <= MAX_SENSORS and powers <= MAX_POWER


def load_kernels(sensors: int) -> None:
    """Load the kernels for a number of sensors, with up to MIN_CAPACITY terms of distortion."""
    for capacity in (0, MIN_CAPACITY):
        step_kernel(sensors, capacity).module.load("cpu", block_dim=1)


def imm_state_size(modes: int, errors: int) -> int:
    """Return the number of float64 of an ImmState.

    Args:
        modes: number K of motion models.
        errors: number E of common errors.
    """
    return POSE + modes * (1 + IMM_STATES + IMM_STATES * (IMM_STATES + errors))


def result_size(sensors: int, errors: int) -> int:
    """Return the number of float64 of a result.

    A result holds the head; the index of each sensor's peak, -1: none; the excluded squares; the
    combined state; the whitened innovations, (n, 1 + E).

    Args:
        sensors: number of sensors.
        errors: number E of common errors.
    """
    return HEAD + 2 * sensors + POSE + STATES * (STATES + errors) + sensors * (1 + errors)


def scratch_size(sensors: int, modes: int, errors: int) -> int:
    """Return the number of float64 of the kernel's scratch memory.

    Args:
        sensors: number of sensors.
        modes: number K of motion models.
        errors: number E of common errors.
    """
    wide = IMM_STATES + errors
    mixing = modes * modes + IMM_STATES * IMM_STATES + IMM_STATES
    readings = sensors * (errors + wide) + modes * (sensors * (1 + wide) + 2)
    return mixing + readings + IMM_STATES * wide
