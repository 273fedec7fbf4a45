"""FrameSteps: prediction, gating and update of all strobed tools of a frame in one launch."""

from collections.abc import Sequence
from ctypes import addressof, c_char
from dataclasses import dataclass
from functools import lru_cache
from itertools import accumulate
from math import prod
from struct import Struct
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from compute.measurement.measurement_model import MeasurementModel
from compute.pose.filtering.imm import IMM_STATES, ImmModel, ImmState
from compute.pose.filtering.native.definitions import (
    FRAME,
    FRAME_FORMAT,
    HEAD,
    MISFIT,
    POSE,
    UPDATED,
)
from compute.pose.filtering.native.kernel_arguments import (
    imm_state_size,
    result_size,
    step_kernel,
    tool_record,
)
from compute.pose.filtering.native.pose_reliability import PoseReliabilityKernel
from compute.pose.filtering.pose_filter import STATES, PoseState, ReportedPose
from compute.pose.rigid_body import CentredMarkers
from compute.reconstruction.solver import term_capacity
from compute.warp_host import PackedLaunch, address

if TYPE_CHECKING:
    from compute.measurement.measurements import Measurements

Array = NDArray[np.float64]

_OF_FRAME: Final = Struct(FRAME_FORMAT)
"""Members of a STEP that change from frame to frame."""
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


class ToolStep(NamedTuple):
    """A tool to be taken to the next exposure.

    Args:
        kernel: the tool.
        before: the states at its last exposure.
        lit: index of the marker that is lit; None: none of it, prediction only.
        manoeuvre_factor: factor on the accelerations of all models.
    """

    kernel: "StrobedStepKernel"
    before: ImmState
    lit: int | None = None
    manoeuvre_factor: float = 1.0


class StrobedStepKernel:
    """A tool of ``FrameSteps``: ImmState and ``associate`` for one lit marker.

    Its readings are unambiguous where each sensor has at most one peak within the marker's gate.
    Otherwise none is used, and the caller associates step by step.

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
        self.imm_model, self.centred = imm, centred
        self.common_errors = common_errors
        self.sensors = sensors = len(model)
        self.capacity = term_capacity(model.cameras)
        self.state_size = imm_state_size(len(imm), common_errors)
        self.result_size = result_size(sensors, common_errors)
        self._switch_probability = lru_cache(maxsize=1)(imm.switch_probability)
        step, self._buffers = tool_record(model, imm, centred, common_errors, gate_probability)
        self._memory: Any = step.view(np.uint8)
        self.address = address(step)
        """Address of its record."""
        self.reliability = PoseReliabilityKernel(
            self.address,
            len(centred.markers_mm),
            sensors,
            self.capacity,
            model.covariance_factor.shape[2],
        )
        """Reliability of its pose."""

    def prepare(
        self,
        job: ToolStep,
        time_ns: int,
        block: int,
        reported: int,
        inputs: tuple[int, int, int, int],
    ) -> None:
        """Write what is of a frame into the record.

        Args:
            job: the step.
            time_ns: time of the exposure [ns].
            block: address of the memory for its results, of ``block_size`` values.
            reported: address of the memory for the reported pose.
            inputs: addresses of positions, variances and usable peaks, and peaks of each sensor.
        """
        before, lit = job.before, job.lit
        after = block if lit is None else block + 8 * self.state_size
        result = block if lit is None else after + 8 * self.state_size
        step_s = 1e-9 * (time_ns - before.widest_state.time_ns)
        _OF_FRAME.pack_into(
            self._memory,
            0,
            before.packed_address,
            block,
            after,
            result,
            reported,
            *inputs,
            -1 if lit is None else lit,
            step_s,
            self._switch_probability(step_s),
            job.manoeuvre_factor,
        )

    def block_size(self, lit: int | None) -> int:
        """Return the number of float64 of the results."""
        return self.result_size + (0 if lit is None else 2 * self.state_size)

    def predicted_pose(self, time_ns: int, block: Array, reported_pose: Array) -> PackedPose:
        """Return the combined state of a tool of which no marker was lit.

        Args:
            time_ns: time of the exposure [ns].
            block: what the kernel wrote of this tool.
            reported_pose: what it wrote of the pose for reports.
        """
        return PackedPose.within(
            time_ns,
            block[HEAD + 2 * self.sensors :],
            POSE,
            0,
            self.common_errors,
            (self.centred, reported_pose),
        )

    def updated(self, time_ns: int, block: Array, at: int, reported_pose: Array) -> Step:
        """Return the step to an exposure that lit a marker.

        Args:
            time_ns: time of the exposure [ns].
            block: what the kernel wrote of this tool.
            at: address of ``block``.
            reported_pose: what the kernel wrote of the pose for reports.
        """
        size, sensors, common_errors = self.state_size, self.sensors, self.common_errors
        after = 2 * size
        outcome, count, nis = block[after : after + HEAD].tolist()
        peak = after + HEAD
        excluded, mixture = peak + sensors, peak + 2 * sensors
        peaks = block[peak:excluded].astype(np.intp)[None]
        readings, known = int(count), outcome in (UPDATED, MISFIT)
        combined = None
        if known:
            combined = PackedPose.within(
                time_ns, block[mixture:], POSE, 0, common_errors, (self.centred, reported_pose)
            )
        predicted = PackedImmState.within(
            self.imm_model,
            time_ns,
            block[:size],
            at,
            common_errors,
            None if readings else combined,
        )
        imm = predicted
        if readings:
            imm = PackedImmState.within(
                self.imm_model, time_ns, block[size:after], at + 8 * size, common_errors, combined
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


class FrameSteps:
    """Steps of several strobed tools to one exposure, in one launch.

    Args:
        sensors: number of sensors.
        capacity: largest number of distortion terms.
    """

    def __init__(self, sensors: int, capacity: int) -> None:
        self._sensors = sensors
        self._inputs: dict[int, tuple[Array, Array, NDArray[np.bool_], tuple[int, int, int]]] = {}
        self._steps = np.empty(0, dtype=np.uint64)
        self._record = np.zeros(1, dtype=FRAME)
        self._launch = PackedLaunch.of_record(step_kernel(sensors, capacity), self._record)

    def take(
        self, jobs: Sequence[ToolStep], time_ns: int, measurements: "Measurements | None"
    ) -> list[Step | PoseState]:
        """Return each tool's step where a marker of it is lit, else its predicted combined state.

        Args:
            jobs: the tools, each once.
            time_ns: time of the exposure, not before those of the tools [ns].
            measurements: the frame's peaks; None: nothing is lit.
        """
        # Where the results of each tool end [values].
        ends = list(accumulate([job.kernel.block_size(job.lit) for job in jobs], initial=0))
        block, reported = np.empty(ends[-1]), np.empty((len(jobs), REPORTED_SIZE))
        first, reported_at = _address_of_new(block), _address_of_new(reported)
        inputs = (0, 0, 0, 0) if measurements is None else self._copy(measurements)
        if len(jobs) > len(self._steps):
            self._steps = np.empty(len(jobs), dtype=np.uint64)
            self._record["steps"] = address(self._steps)
        for index, job in enumerate(jobs):
            reported_pose = reported_at + 8 * REPORTED_SIZE * index
            job.kernel.prepare(job, time_ns, first + 8 * ends[index], reported_pose, inputs)
        self._steps[: len(jobs)] = [job.kernel.address for job in jobs]
        self._record["count"] = len(jobs)
        self._launch.run()
        found: list[Step | PoseState] = []
        for index, job in enumerate(jobs):
            kernel, part = job.kernel, block[ends[index] : ends[index + 1]]
            if job.lit is not None:
                at = first + 8 * ends[index]
                found.append(kernel.updated(time_ns, part, at, reported[index]))
            elif time_ns == job.before.widest_state.time_ns:
                found.append(job.before.combined)
            else:
                found.append(kernel.predicted_pose(time_ns, part, reported[index]))
        return found

    def _copy(self, measurements: "Measurements") -> tuple[int, int, int, int]:
        """Copy the peaks; return the addresses, and the number of peaks of each sensor."""
        peaks = measurements.position_px.shape[1]
        if peaks not in self._inputs:
            shape = self._sensors, peaks
            new = np.empty(shape), np.empty(shape), np.empty(shape, dtype=np.bool_)
            self._inputs[peaks] = *new, (address(new[0]), address(new[1]), address(new[2]))
        position, variance, usable, at = self._inputs[peaks]
        position[:] = measurements.position_px
        variance[:] = measurements.variance_px2
        usable[:] = measurements.usable
        return *at, peaks


def _address_of_new(array: Any) -> int:
    """Return the address of a writable array in a third of the time that ``address`` takes."""
    return addressof(c_char.from_buffer(array))
