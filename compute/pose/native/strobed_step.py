"""StrobedStep: a strobed tool's exposure in one launch: predicted, its readings found and taken."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from compute.camera.stack import CameraStack
from compute.mapping.table import CorrectionTable
from compute.pose.marker_frame import MarkerFrame
from compute.pose.native.packed import PackedPose, PackedRegimes
from compute.pose.native.record import (
    FIGURES_SIZE,
    FRAME_NUMBERS,
    FRAME_WORDS,
    HEAD,
    POSE,
    STEP,
    TAKEN,
    regimes_size,
    result_size,
    scratch_size,
)
from compute.pose.pose_filter import STATES, PoseState
from compute.pose.reading_model import ReadingModel
from compute.pose.regime_model import RegimeModel
from compute.pose.regimes import Regimes
from compute.reconstruction.native.camera_record import fill_cameras
from compute.reconstruction.native.job import JOB, MAX_POWER, row_length
from compute.reconstruction.native.launch import address
from compute.reconstruction.points import chi2_limit
from compute.reconstruction.solver import LEAST_ROOM, MAX_SENSORS, term_room

if TYPE_CHECKING:
    from compute.pose.association import FramePeaks

Array = NDArray[np.float64]


_NONE_LIT: Final = 2**64 - 1
"""-1, as the unsigned words that a record is written in."""
_Given = tuple[Array, Array, NDArray[np.bool_], tuple[int, int, int]]


@dataclass(frozen=True, eq=False)
class Step:
    """What an exposure did to a tool.

    Args:
        predicted: its regimes at the exposure, before its readings.
        regimes: after them; None: what the readings say is not plain, nothing was taken.
        peaks: which peak of each sensor was taken, -1: none, shape (1, S).
        readings: how many were taken.
        nis: their normalised innovation squared.
        whitened: their innovations and slopes, as of RegimesUpdate, shape (n, 1 + E).
    """

    predicted: Regimes
    regimes: Regimes | None
    peaks: NDArray[np.intp]
    readings: int
    nis: float
    whitened: Array


class StrobedStep:
    """What Regimes and ``associate`` do of one lit marker where all is plain, in one launch.

    Each sensor has one peak at most that the marker may be, and the readings
    fit one another: then they are taken. Else nothing is, and who asked does it step by step.

    Warp is not thread-safe: the thread that makes it calls it. Making it loads Warp and compiles
    the kernel for this number of sensors unless an earlier process has (seconds).

    Args:
        model: the cameras, which ``can_step`` said yes to.
        regimes: of motion.
        frame: the tool's markers.
        errors: number of common errors of its filter.
        gate_probability: chance that a right reading is not taken for its marker.
    """

    def __init__(
        self,
        model: ReadingModel,
        regimes: RegimeModel,
        frame: MarkerFrame,
        errors: int,
        gate_probability: float,
    ) -> None:
        import warp as wp

        from compute.pose.native.kernel import step_kernel

        self._model, self._frame = regimes, frame
        self._errors = errors
        self._sensors = sensors = model.sensors
        self._size = regimes_size(len(regimes), errors)
        self._room = 2 * self._size + result_size(sensors, errors)
        self._inputs: dict[int, _Given] = {}
        self._steps: tuple[int, float] = (0, 0.0)
        step = np.zeros(1, dtype=STEP)
        cameras = _cameras(model.cameras, model.corrections)
        columns = model.common * model.cameras.owned[..., None]
        limits = [chi2_limit(count, gate_probability) for count in range(sensors + 1)]
        # Kept: the records have their addresses.
        self._kept: list[Any] = [step, *cameras]
        for name, values in (
            ("cameras", cameras[0]),
            ("columns", columns),
            ("states", regimes.states),
            ("begun", regimes.begun),
            ("brief", regimes.brief),
            ("terms", regimes.terms),
            ("markers", frame.markers_mm),
            ("limits", np.array(limits)),
            ("scratch", np.empty(scratch_size(sensors, len(regimes), errors))),
        ):
            there = np.ascontiguousarray(values)
            step[name] = address(there)
            self._kept.append(there)
        step["regimes"], step["errors"], step["own_errors"] = len(regimes), errors, columns.shape[2]
        step["gate"] = chi2_limit(1, gate_probability)
        step["radius"] = frame.radius_mm
        step["focal"] = model.cameras.principal_distance_px.min()
        step["middle"], step["tip"] = frame.centroid_mm, frame.tip_mm
        self._words = step.view(np.uint64)[:FRAME_WORDS]
        self._numbers = step.view(np.float64)[FRAME_WORDS : FRAME_WORDS + FRAME_NUMBERS]
        # Loads the kernel, before the first frame waits for it.
        self._launch = wp.launch(
            step_kernel(sensors, term_room(model.cameras)),
            dim=1,
            inputs=[address(step)],
            device="cpu",
            record_cmd=True,
        )

    def take(
        self,
        before: Regimes,
        time_ns: int,
        lit: int,
        seen: "FramePeaks",
        manoeuvre: float = 1.0,
    ) -> Step:
        """Return the step to an exposure.

        Args:
            before: the tool's regimes at its last exposure.
            time_ns: of this one, not earlier.
            lit: index of the marker that it lights.
            seen: the frame's peaks.
            manoeuvre: factor on the accelerations of all regimes.
        """
        size, sensors, errors = self._size, self._sensors, self._errors
        block, figures = np.empty(self._room), np.empty(FIGURES_SIZE)
        first = address(block)
        peaks_each = seen.position_px.shape[1]
        position, variance, usable, at = self._given(peaks_each)
        position[:], variance[:], usable[:] = seen.position_px, seen.variance_px2, seen.usable
        self._words[:] = (
            before.packed_at,
            first,
            first + 8 * size,
            first + 16 * size,
            address(figures),
            *at,
            peaks_each,
            lit,
        )
        self._run(before, time_ns, manoeuvre)
        after = 2 * size
        how, count, nis, _ = block[after : after + HEAD].tolist()
        peak, whole = after + HEAD, after + HEAD + sensors
        peaks = block[peak:whole].astype(np.intp)[None]
        readings = int(count)
        if how != TAKEN:
            predicted = PackedRegimes.within(self._model, time_ns, block[:size], errors)
            return Step(predicted, None, np.full_like(peaks, -1), 0, 0.0, _nothing(errors))
        pose = PackedPose.within(time_ns, block[whole:], POSE, 0, errors, (self._frame, figures))
        if not readings:
            predicted = PackedRegimes.within(self._model, time_ns, block[:size], errors, pose)
            return Step(predicted, predicted, peaks, 0, 0.0, _nothing(errors))
        predicted = PackedRegimes.within(self._model, time_ns, block[:size], errors)
        regimes = PackedRegimes.within(self._model, time_ns, block[size:after], errors, pose)
        white = whole + POSE + STATES * (STATES + errors)
        # A copy: it is kept for some exposures, which the rest of the block need not be.
        whitened = block[white : white + readings * (1 + errors)].reshape(readings, -1).copy()
        return Step(predicted, regimes, peaks, readings, nis, whitened)

    def ahead(self, before: Regimes, time_ns: int) -> PoseState:
        """Return what all regimes together expect at an instant, as ``Regimes.ahead``."""
        if time_ns == before.widest.time_ns:
            return before.whole
        sensors, errors = self._sensors, self._errors
        block, figures = np.empty(result_size(sensors, errors)), np.empty(FIGURES_SIZE)
        result = address(block)
        self._words[:] = before.packed_at, 0, 0, result, address(figures), 0, 0, 0, 0, _NONE_LIT
        self._run(before, time_ns, 1.0)
        whole = block[HEAD + sensors :]
        return PackedPose.within(time_ns, whole, POSE, 0, errors, (self._frame, figures))

    def _run(self, before: Regimes, time_ns: int, manoeuvre: float) -> None:
        between = time_ns - before.widest.time_ns
        self._numbers[:] = 1e-9 * between, self._change(between), manoeuvre
        self._launch.launch()

    def _given(self, peaks: int) -> _Given:
        """Return memory for so many peaks of each sensor, and its addresses."""
        if peaks not in self._inputs:
            shape = self._sensors, peaks
            position, variance = np.empty(shape), np.empty(shape)
            usable = np.empty(shape, dtype=np.bool_)
            at = address(position), address(variance), address(usable)
            self._inputs[peaks] = position, variance, usable, at
        return self._inputs[peaks]

    def _change(self, between_ns: int) -> float:
        """Return the chance to change to one certain other regime, as ``RegimeModel.switching``."""
        if self._steps[0] != between_ns:
            self._steps = between_ns, self._model.change(1e-9 * between_ns)
        return self._steps[1]


def _nothing(errors: int) -> Array:
    return np.empty((0, 1 + errors))


def can_step(model: ReadingModel, regimes: RegimeModel) -> bool:
    """Return whether a kernel can follow in these regimes, and there is one for these cameras."""
    cameras = model.cameras
    powers = max((max(term) for term in cameras.terms), default=0)
    return len(regimes) > 1 and 1 <= len(cameras) <= MAX_SENSORS and powers <= MAX_POWER


def load_kernels(sensors: int) -> None:
    """Load what steps for so many sensors need, with up to LEAST_ROOM terms of distortion."""
    from compute.pose.native.kernel import step_kernel

    for room in (0, LEAST_ROOM):
        step_kernel(sensors, room).module.load("cpu", block_dim=1)


def _cameras(stack: CameraStack, corrections: CorrectionTable | None) -> list[NDArray[Any]]:
    """Return the cameras and the table as a JOB, and the arrays that it has the addresses of."""
    job = np.zeros(1, dtype=JOB)
    kept: list[NDArray[Any]] = [job]

    def put(name: str, array: NDArray[Any]) -> None:
        kept.append(np.ascontiguousarray(array))
        job[name] = address(kept[-1])

    fill_cameras(job, put, stack, corrections, row_length(len(stack), cuda=False))
    return kept
