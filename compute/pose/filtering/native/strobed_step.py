"""FrameSteps: prediction, gating and update of all strobed tools of a frame in one launch."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from itertools import accumulate
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
    STEP,
    UPDATED,
)
from compute.pose.filtering.native.packed_states import (
    REPORTED_SIZE,
    PackedImmState,
    PackedPose,
)
from compute.pose.filtering.native.pose_reliability import (
    PoseReliabilityKernel,
    reliability_kernel,
)
from compute.pose.filtering.pose_filter import STATES, PoseState
from compute.pose.rigid_body import CentredMarkers
from compute.reconstruction.native.definitions import MAX_POWER, fill_cameras, row_length
from compute.reconstruction.solver import MAX_SENSORS, MIN_CAPACITY, term_capacity
from compute.reconstruction.triangulation import chi2_limit
from compute.warp_host import PackedLaunch, address

if TYPE_CHECKING:
    from compute.measurement.measurements import Measurements

Array = NDArray[np.float64]

_OF_FRAME: Final = Struct(FRAME_FORMAT)
"""Members of a STEP that change from frame to frame."""


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
        self._memory: Any = step.view(np.uint8)
        self.address = address(step)
        """Address of its record."""
        self.reliability = PoseReliabilityKernel(
            self.address, len(centred.markers_mm), sensors, self.capacity, columns.shape[2]
        )
        """Reliability of its pose."""
        self._alone = FrameSteps(sensors, self.capacity)

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
        """Return the combined state of a tool of which no marker was lit."""
        return PackedPose.within(
            time_ns,
            block[HEAD + 2 * self.sensors :],
            POSE,
            0,
            self.common_errors,
            (self.centred, reported_pose),
        )

    def updated(self, time_ns: int, block: Array, at: int, reported_pose: Array) -> Step:
        """Return the step to an exposure that lit a marker."""
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
        job = ToolStep(self, before, lit, manoeuvre_factor)
        (found,) = self._alone.take([job], time_ns, measurements)
        assert isinstance(found, Step)
        return found

    def predict_combined(self, before: ImmState, time_ns: int) -> PoseState:
        """Return the combined state predicted to a time, as ``ImmState.predict_combined``.

        Args:
            before: the states at the tool's last exposure.
            time_ns: the time, not earlier [ns].
        """
        (found,) = self._alone.take([ToolStep(self, before)], time_ns, None)
        assert isinstance(found, PoseState)
        return found

    def _keep(self, values: NDArray[Any]) -> int:
        array = np.ascontiguousarray(values)
        self._buffers.append(array)
        return address(array)


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
        first, reported_at = address(block), address(reported)
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


@cache
def step_kernel(sensors: int, capacity: int) -> Any:
    """Return the strobed-step kernel; it takes the address of a FRAME.

    Loads Warp. Launch it with one thread, on the CPU.

    Args:
        sensors: number of sensors.
        capacity: largest number of distortion terms.
    """
    from compute.native.native_kernel import native_kernel

    return native_kernel(
        "compute/pose/filtering/native/strobed_step.h",
        f"lumiline::pose::take_steps<{sensors}, {capacity}>(address);",
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
        for kernel in (step_kernel, reliability_kernel):
            kernel(sensors, capacity).module.load("cpu", block_dim=1)


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
