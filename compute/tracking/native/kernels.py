"""Predictor and Associator: the tracks' prediction, association and update by native kernels."""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from compute.measurement.measurement_model import MeasurementModel
from compute.measurement.measurements import Measurements
from compute.reconstruction.native.definitions import fill_cameras, row_length
from compute.reconstruction.solver import term_capacity
from compute.tracking.association import associate
from compute.tracking.motion_model import STATE_SIZE, CombinedState, ImmStates, MotionModels
from compute.tracking.native.definitions import JOB, MAX_OPTIONS, PARTIAL_BYTES, PREDICTION
from compute.tracking.settings import TrackerSettings
from compute.tracking.tracks import AssociationResult
from compute.warp_host import PackedLaunch, address

Array = NDArray[np.float64]

_GROWN: Final = 64
"""Partial hypotheses that there is room for, in parts of those that are kept."""
_PREDICTION_ARRAYS: Final = 12
"""Addresses at the head of the record of a prediction."""
_NO_MIXTURES: Final = (0, 0, 0)


class Predictor:
    """``mix_and_predict`` and ``combine_modes`` by the kernel, to rounding.

    Warp is not thread-safe: one thread makes it and calls it. The kernel is compiled when it is
    first made (seconds), and is cached on disk.

    Args:
        motion: M motion models.
        sensors: number of sensors S.
    """

    def __init__(self, motion: MotionModels, sensors: int) -> None:
        # Here and not above: it loads Warp, which takes a second.
        from compute.native.native_kernel import native_kernel

        self._job = job = np.zeros(1, dtype=PREDICTION.dtype)
        self._words = job.view(np.uint64)
        job["models"], job["sensors"] = len(motion), sensors
        has = motion.has_acceleration
        job["acceleration_source"] = has.index(True) if len(set(has)) > 1 else -1
        job["has_acceleration"][0, : len(motion)] = has
        job["noise_psd"][0, : len(motion)] = motion.noise_psd
        job["mean_sojourn_s"] = motion.mean_sojourn_s
        self._tracks = job["tracks"]
        kernel = native_kernel(
            "compute/tracking/native/prediction.h", "lumiline::tracking::predict_tracks(address);"
        )
        self._launch = PackedLaunch.of_record(kernel, job)

    def predict(self, states: ImmStates, step_s: Array) -> ImmStates:
        """Return what ``mix_and_predict`` returns.

        Args:
            states: of T tracks.
            step_s: time step of each track, shape (T,) [s].
        """
        return self._run(states, step_s, None)

    def combined(self, states: ImmStates, step_s: Array) -> CombinedState:
        """Return what ``combine_modes`` returns of the states after ``mix_and_predict``.

        Args:
            states: of T tracks.
            step_s: time step of each track, 0: as it is, shape (T,) [s].
        """
        count, sensors = len(states), states.bias_cross_covariance.shape[-1]
        mixed = CombinedState(
            np.empty((count, STATE_SIZE)),
            np.empty((count, STATE_SIZE, STATE_SIZE)),
            np.empty((count, STATE_SIZE, sensors)),
        )
        self._run(states, step_s, mixed)
        return mixed

    def _run(self, states: ImmStates, step_s: Array, mixed: CombinedState | None) -> ImmStates:
        before = [np.ascontiguousarray(values) for values in vars(states).values()]
        step = np.ascontiguousarray(step_s)
        after = [np.empty_like(values) for values in before]
        arrays: list[NDArray[Any]] = [*before, step, *after]
        mixtures = _NO_MIXTURES if mixed is None else map(address, vars(mixed).values())
        self._words[:_PREDICTION_ARRAYS] = [*map(address, arrays), *mixtures]
        self._tracks[0] = len(step)
        self._launch.run()
        return ImmStates(*after)


class Associator:
    """Associates by the kernel; clusters beyond its capacity are left to the NumPy code.

    Warp is not thread-safe: one thread makes it and calls it. The kernel is compiled when it is
    first made for a number of sensors (seconds), and is cached on disk.

    Args:
        model: the measurement model, of S sensors.
        motion: M motion models.
        settings: detection probability, clutter density and gate.
    """

    def __init__(
        self, model: MeasurementModel, motion: MotionModels, settings: TrackerSettings
    ) -> None:
        # Here and not above: it loads Warp, which takes a second.
        from compute.native.native_kernel import native_kernel

        self.model, self.motion, self.settings = model, motion, settings
        cameras = model.cameras
        self._job = np.zeros(1, dtype=JOB)
        # Kept: the job has their addresses.
        self._arrays: list[NDArray[Any]] = []
        row = row_length(len(cameras), cuda=False)
        job = self._job
        fill_cameras(job["cameras"], self._keep, cameras, model.corrections, row)
        job["first"], job["last"] = self._keep(model.first_px), self._keep(model.last_px)
        for name in (
            "detection_probability",
            "clutter_density_per_px",
            "resolution_px",
            "gate_sigma",
            "max_prediction_sigma_px",
        ):
            job[name] = getattr(settings, name)
        job["models"] = len(motion)
        job["max_hypotheses"] = settings.max_hypotheses
        grown = max(_GROWN * settings.max_hypotheses, MAX_OPTIONS + 1)
        job["max_grown"] = grown
        partials = (settings.max_hypotheses + grown) * PARTIAL_BYTES
        job["partials"] = self._keep(np.empty(partials, np.uint8))
        self._grown = grown
        self._tracks = self._room = 0
        self._work: list[NDArray[Any]] = []
        sizes = f"{len(cameras)}, {term_capacity(cameras)}"
        kernel = native_kernel(
            "compute/tracking/native/association.h",
            f"lumiline::tracking::associate_frame<{sizes}>(address);",
        )
        self._launch = PackedLaunch.of_record(kernel, job)

    def associate(self, states: ImmStates, bias: Array, peaks: Measurements) -> AssociationResult:
        """Return what ``compute.tracking.association.associate`` returns, by the native kernel.

        Args:
            states: of T tracks, predicted to the exposure.
            bias: covariance of the readings' constant errors, shape (T, S, S) [px^2].
            peaks: measurements of the exposure.
        """
        count = len(states)
        room = peaks.position_px.shape[1]
        job = self._job
        if count > self._tracks or room > self._room:
            self._reserve(max(count, self._tracks), max(room, self._room))
        after = ImmStates(*(np.array(value, order="C") for value in vars(states).values()))
        result = AssociationResult.missed(after, len(self.model))
        _, *written = vars(result).values()
        arrays = (
            *vars(after).values(),
            np.ascontiguousarray(bias),
            np.ascontiguousarray(peaks.position_px),
            np.ascontiguousarray(peaks.variance_px2),
            np.ascontiguousarray(peaks.usable),
            *written,
        )
        words = job.view(np.uint64)
        words[: len(arrays)] = [address(array) for array in arrays]
        job["tracks"], job["room"], job["failed"] = count, room, 0
        self._launch.run()
        if job["failed"][0]:
            return associate(self.model, self.motion, self.settings, states, bias, peaks)
        return result

    def _reserve(self, tracks: int, room: int) -> None:
        sensors = len(self.model)
        self._tracks, self._room = tracks, room
        self._work = [
            np.empty(tracks * (15 + 9 * sensors)),
            np.empty(2 * tracks * sensors + sensors * room, np.uint8),
            np.empty(max(self._grown, tracks * sensors), np.int32),
        ]
        for name, array in zip(("numbers", "marks", "order"), self._work, strict=True):
            self._job[name] = address(array)

    def _keep(self, array: NDArray[Any]) -> int:
        values = np.ascontiguousarray(array)
        self._arrays.append(values)
        return address(values)
