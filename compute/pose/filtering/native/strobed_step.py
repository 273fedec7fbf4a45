"""StrobedStepKernel: prediction, gating and update of a strobed tool in one launch."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from compute.measurement.measurement_model import MeasurementModel
from compute.pose.filtering.imm_model import ImmModel
from compute.pose.filtering.imm_state import ImmState
from compute.pose.filtering.native.kernel_arguments import (
    FIGURES_SIZE,
    FRAME_NUMBERS,
    FRAME_WORDS,
    HEAD,
    POSE,
    STEP,
    TAKEN,
    PackedImmState,
    PackedPose,
    imm_state_size,
    result_size,
    scratch_size,
)
from compute.pose.filtering.pose_filter import STATES, PoseState
from compute.pose.rigid_body import CentredMarkers
from compute.reconstruction.native.definitions import MAX_POWER, fill_cameras, row_length
from compute.reconstruction.solver import MAX_SENSORS, MIN_CAPACITY, address, term_capacity
from compute.reconstruction.triangulation import chi2_limit

if TYPE_CHECKING:
    from compute.measurement.measurements import Measurements

Array = NDArray[np.float64]


_NONE_LIT: Final = 2**64 - 1
"""-1, as the unsigned words that a record is written in."""
_Given = tuple[Array, Array, NDArray[np.bool_], tuple[int, int, int]]


@dataclass(frozen=True, eq=False)
class Step:
    """A tool after an exposure.

    Args:
        predicted: predicted states at the exposure.
        imm: updated states; None: the readings are not unambiguous, none was used.
        peaks: index of each sensor's peak, -1: none, shape (1, S).
        readings: number of readings that were used.
        nis: their normalised innovation squared.
        whitened: their whitened innovations and Jacobian, as in ImmUpdate, shape (n, 1 + E).
    """

    predicted: ImmState
    imm: ImmState | None
    peaks: NDArray[np.intp]
    readings: int
    nis: float
    whitened: Array


class StrobedStepKernel:
    """ImmState and ``associate`` for one lit marker with unambiguous readings, in one launch.

    They are unambiguous where each sensor has at most one peak within the marker's gate, and these
    fit one another. Otherwise no reading is used, and the caller associates step by step.

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
        import warp as wp

        from compute.pose.filtering.native.kernel import step_kernel

        self._model, self._centred = imm, centred
        self._common_errors = common_errors
        self._sensors = sensors = len(model)
        self._size = imm_state_size(len(imm), common_errors)
        self._room = 2 * self._size + result_size(sensors, common_errors)
        self._inputs: dict[int, _Given] = {}
        self._steps: tuple[int, float] = (0, 0.0)
        step = np.zeros(1, dtype=STEP)
        columns = model.covariance_factor * model.cameras.parameter_mask[..., None]
        limits = [chi2_limit(count, gate_probability) for count in range(sensors + 1)]
        # Kept alive: the records hold their addresses.
        self._kept: list[Any] = [step]
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
        step["modes"], step["errors"], step["own_errors"] = (
            len(imm),
            common_errors,
            columns.shape[2],
        )
        step["gate"] = chi2_limit(1, gate_probability)
        step["radius_mm"] = centred.radius_mm
        step["principal_distance_px"] = model.cameras.principal_distance_px.min()
        step["centroid"], step["tip"] = centred.centroid_mm, centred.tip_mm
        self._words = step.view(np.uint64)[:FRAME_WORDS]
        self._numbers = step.view(np.float64)[FRAME_WORDS : FRAME_WORDS + FRAME_NUMBERS]
        # Loads the kernel now, not at the first frame.
        self._launch = wp.launch(
            step_kernel(sensors, term_capacity(model.cameras)),
            dim=1,
            inputs=[address(step)],
            device="cpu",
            record_cmd=True,
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
        size, sensors, common_errors = self._size, self._sensors, self._common_errors
        block, reported_pose = np.empty(self._room), np.empty(FIGURES_SIZE)
        first = address(block)
        peaks_each = measurements.position_px.shape[1]
        position, variance, usable, at = self._given(peaks_each)
        position[:], variance[:], usable[:] = (
            measurements.position_px,
            measurements.variance_px2,
            measurements.usable,
        )
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
        how, count, nis, _ = block[after : after + HEAD].tolist()
        peak, whole = after + HEAD, after + HEAD + sensors
        peaks = block[peak:whole].astype(np.intp)[None]
        readings = int(count)
        if how != TAKEN:
            predicted = PackedImmState.within(self._model, time_ns, block[:size], common_errors)
            return Step(predicted, None, np.full_like(peaks, -1), 0, 0.0, _nothing(common_errors))
        pose = PackedPose.within(
            time_ns, block[whole:], POSE, 0, common_errors, (self._centred, reported_pose)
        )
        if not readings:
            predicted = PackedImmState.within(
                self._model, time_ns, block[:size], common_errors, pose
            )
            return Step(predicted, predicted, peaks, 0, 0.0, _nothing(common_errors))
        predicted = PackedImmState.within(self._model, time_ns, block[:size], common_errors)
        imm = PackedImmState.within(self._model, time_ns, block[size:after], common_errors, pose)
        white = whole + POSE + STATES * (STATES + common_errors)
        # A copy: it is kept for some exposures, the rest of the block is not.
        whitened = (
            block[white : white + readings * (1 + common_errors)].reshape(readings, -1).copy()
        )
        return Step(predicted, imm, peaks, readings, nis, whitened)

    def predict_combined(self, before: ImmState, time_ns: int) -> PoseState:
        """Return the combined state predicted to a time, as ``ImmState.predict_combined``.

        Args:
            before: the states at the tool's last exposure.
            time_ns: the time, not earlier [ns].
        """
        if time_ns == before.widest_state.time_ns:
            return before.combined
        sensors, common_errors = self._sensors, self._common_errors
        block, reported_pose = np.empty(result_size(sensors, common_errors)), np.empty(FIGURES_SIZE)
        result = address(block)
        self._words[:] = (
            before.packed_address,
            0,
            0,
            result,
            address(reported_pose),
            0,
            0,
            0,
            0,
            _NONE_LIT,
        )
        self._run(before, time_ns, 1.0)
        whole = block[HEAD + sensors :]
        return PackedPose.within(
            time_ns, whole, POSE, 0, common_errors, (self._centred, reported_pose)
        )

    def _run(self, before: ImmState, time_ns: int, manoeuvre_factor: float) -> None:
        between = time_ns - before.widest_state.time_ns
        self._numbers[:] = 1e-9 * between, self._change(between), manoeuvre_factor
        self._launch.launch()

    def _keep(self, values: NDArray[Any]) -> int:
        there = np.ascontiguousarray(values)
        self._kept.append(there)
        return address(there)

    def _given(self, peaks: int) -> _Given:
        """Return input arrays for a number of peaks per sensor, and their addresses."""
        if peaks not in self._inputs:
            shape = self._sensors, peaks
            position, variance = np.empty(shape), np.empty(shape)
            usable = np.empty(shape, dtype=np.bool_)
            at = address(position), address(variance), address(usable)
            self._inputs[peaks] = position, variance, usable, at
        return self._inputs[peaks]

    def _change(self, between_ns: int) -> float:
        """Return ``ImmModel.switch_probability`` of a time step [ns]; the last one is cached."""
        if self._steps[0] != between_ns:
            self._steps = between_ns, self._model.switch_probability(1e-9 * between_ns)
        return self._steps[1]


def _nothing(common_errors: int) -> Array:
    return np.empty((0, 1 + common_errors))


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
    from compute.pose.filtering.native.kernel import step_kernel

    for room in (0, MIN_CAPACITY):
        step_kernel(sensors, room).module.load("cpu", block_dim=1)
