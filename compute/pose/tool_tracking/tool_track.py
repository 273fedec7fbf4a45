"""ToolTrack: state of one tool between exposures, and the consistency of its readings."""

from collections import deque
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, reduce
from math import cos, sqrt
from operator import or_
from typing import Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from compute.measurement.measurement_model import MeasurementModel
from compute.measurement.measurements import Measurements
from compute.pose.acquisition.acquisition_strobed import AcquisitionBackoff, MarkerExposure
from compute.pose.estimation.pose_equations import PoseEquations
from compute.pose.estimation.pose_reliability import PoseReliability, pose_reliability
from compute.pose.filtering.association import (
    MAX_EXCLUDED_NIS,
    ToolObservation,
    marker_readings,
)
from compute.pose.filtering.imm import ImmModel, ImmState
from compute.pose.filtering.native.strobed_step import (
    Step,
    StrobedStepKernel,
    ToolStep,
)
from compute.pose.filtering.pose_filter import PoseState, predict
from compute.pose.rigid_body import CentredMarkers, PoseStatus, RigidBody
from compute.pose.settings import MotionSettings
from compute.reconstruction.triangulation import chi2_limit

Array = NDArray[np.float64]
T = TypeVar("T")

ACQUISITION_CYCLES: Final = 2
"""Number of exposures of each marker that a strobed tool is found from."""
COAST_CYCLES: Final = 1.25
"""Shortest prediction without readings in strobe cycles: one, and some lost frames."""
CONSISTENCY_CYCLES: Final = 4
"""Number of exposures of each marker whose readings, excluded ones too, are tested together."""
EXCLUSION_COUNT_THRESHOLD: Final = 3
"""Number of exposures with excluded readings, in CONSISTENCY_CYCLES, that is more than chance."""
WEAK_FRACTION: Final = 0.5
"""A frame with fewer than this fraction of the last frame's readings is tried again with larger
accelerations."""
_HISTORIES: Final = (
    "recent_updates",
    "recent_used",
    "recent_residuals",
    "exposures",
    "fit_history",
)
_SAME_ROTATION_TRACE: Final = 1.0 + 2.0 * cos(0.1)
"""Trace of a rotation by 0.1 rad."""
_MIN_VARIANCE: Final = 0.05
"""Smallest variance of a combination of whitened readings: smaller ones are rounding errors."""


@dataclass(frozen=True, eq=False)
class ExposureResiduals:
    """Residuals of the readings of one exposure.

    Args:
        sum_of_squares: sum of their normalised squares, excluded readings included.
        count: number of readings.
        excluded: number of excluded readings of each marker, shape (M,); None: none was.
        whitened: whitened innovations of the readings that were used, and their Jacobian with
            respect to the common errors, shape (n, 1 + E); None: unknown.
    """

    sum_of_squares: float
    count: int
    excluded: NDArray[np.intp] | None = None
    whitened: Array | None = None


def chi2_test(
    exposures: Iterable[ExposureResiduals], probability: float
) -> tuple[float, int, float]:
    """Return the sum of squares of several exposures, the number of readings, and the limit.

    Where the sum is too large for independent errors, and the common errors are known, it is that
    of the jointly whitened readings.

    Args:
        exposures: residuals of the exposures.
        probability: probability that correct readings are rejected.
    """
    sum_of_squares, count = 0.0, 0
    for one in exposures:
        sum_of_squares += one.sum_of_squares
        count += one.count
    limit = chi2_limit(count, probability)
    if sum_of_squares > limit:
        whitened = [one.whitened for one in exposures if one.whitened is not None]
        if whitened and whitened[0].shape[1] > 1:
            sum_of_squares = min(sum_of_squares, _jointly_whitened(sum_of_squares, whitened))
    return sum_of_squares, count, limit


def _jointly_whitened(sum_of_squares: float, whitened: Sequence[Array]) -> float:
    """Return the sum of squares with the innovations of all exposures whitened jointly."""
    value = np.concatenate([one[:, 0] for one in whitened])
    common = np.concatenate([one[:, 1:] for one in whitened])
    covariance = common @ common.T
    first = 0
    for one in whitened:
        block = slice(first, first + len(one))
        covariance[block, block] = np.eye(len(one))
        first += len(one)
    size, axes = np.linalg.eigh(covariance)
    alone = float(value @ value)
    along = axes.T @ value
    return sum_of_squares - alone + float((along**2 / np.maximum(size, _MIN_VARIANCE)).sum())


@dataclass(frozen=True, eq=False)
class TrackReliability:
    """Reliability of a tracked tool's pose, cached with the readings and pose it is for.

    Args:
        value: the reliability.
        used: which readings, as ``pack_mask`` packs a mask of shape (M, S).
        rotation: R_world_tool, shape (3, 3).
        centroid_mm: centroid of the markers, shape (3,) [mm].
    """

    value: PoseReliability
    used: int
    rotation: Array
    centroid_mm: Array

    def holds(self, state: PoseState, used: int, radius_mm: float) -> bool:
        """Return whether it is still that of a state, to a few per cent.

        Args:
            state: the tool's state.
            used: which readings its pose is based on, packed.
            radius_mm: RMS distance of the markers from their centroid.
        """
        if used != self.used:
            return False
        shift = state.centroid_mm - self.centroid_mm
        trace = float(np.vdot(self.rotation, state.rotation))
        return float(shift @ shift) <= radius_mm**2 and trace >= _SAME_ROTATION_TRACE


ExposureReadings = tuple[NDArray[np.intp], NDArray[np.intp], Measurements]
"""Lit markers (m,), index of each one's peak on each sensor (m, S), and the peaks."""
Update = tuple[float, int, int]
"""NIS and number of readings of an update, and which sensor read which marker, packed."""


def pack_mask(mask: NDArray[np.bool_]) -> int:
    """Return a mask as an integer: one bit for each member, in their order in memory."""
    return int.from_bytes(np.packbits(mask, bitorder="little").tobytes(), "little")


def unpack_mask(packed: int, shape: tuple[int, int]) -> NDArray[np.bool_]:
    """Return the mask that ``pack_mask`` packed.

    Args:
        packed: its bits.
        shape: of the mask.
    """
    count = shape[0] * shape[1]
    words = np.frombuffer(packed.to_bytes((count + 7) // 8, "little"), dtype=np.uint8)
    return np.unpackbits(words, count=count, bitorder="little").astype(np.bool_).reshape(shape)


@dataclass(frozen=True, eq=False)
class UsedReadings:
    """Readings of the last updates of a tool.

    Args:
        which: which sensor read which marker, packed.
        readings: number of these.
        markers: number of their markers.
        residual_sigma: root of the mean NIS per reading; None without any reading.
    """

    which: int
    readings: int
    markers: int
    residual_sigma: float | None

    @classmethod
    def of(cls, updates: Collection[Update], sensors: int) -> "UsedReadings":
        """Return those of the last updates.

        Args:
            updates: normalised squared error, number of readings and which they were, of each.
            sensors: number of sensors.
        """
        which, count, square = 0, 0, 0.0
        for nis, readings, sensors_of in updates:
            which |= sensors_of
            count += readings
            square += nis
        markers, rest, one_marker = 0, which, (1 << sensors) - 1
        while rest:
            markers += rest & one_marker != 0
            rest >>= sensors
        residual_sigma = sqrt(square / count) if count else None
        return cls(which, which.bit_count(), markers, residual_sigma)


@dataclass(eq=False)
class ToolTrack:
    """A tool and the state of its tracking.

    Args:
        body: its markers.
        sensors: number S of sensors.
        common_errors: number of common errors of its filter.
        imm_model: motion models of a strobed tool; None: one motion model. Markers that are lit
            together determine the pose in every frame: motion models add little.
        kernel: for unambiguous exposures; None: one motion model, or there is none.
        state: state of its filter at the last frame; None: it is lost.
        imm: states of a strobed tool's motion models at its last exposure; None: there is one.
        updated_ns: time of the last readings [ns].
        recent_updates: its last updates: NIS, number of readings, markers and sensors.
        recent_used: readings of its updates over CONSISTENCY_CYCLES, packed.
        last_readings: readings by the first marker that an exposure lit.
        sigma_px: standard deviations of its readings when they were last needed, shape (M, S)
            [px]; NaN where unknown.
        reliability: that of its pose, and what it was computed for; None: not computed yet.
        exposures_to_reliability: number of frames until that is looked at again.
        recent_residuals: residuals of its last exposures.
        exposures: the last exposures of a lost strobed tool.
        exposures_since_search: number of exposures since the last unsuccessful search.
        backoff: when a lost strobed tool is searched for again.
        fit_history: whether each of its last exposures fitted it.
        exposures_to_confirm: number of consecutive exposures that must fit before a strobed tool
            that was just found is reported: it may have been found from a false peak.
        lit_by_slot: cache of the markers that each slot lights.
        status: status of a lost tool.
        reason: why it is lost.
    """

    body: RigidBody
    sensors: int
    common_errors: int
    imm_model: ImmModel | None = None
    kernel: StrobedStepKernel | None = None
    state: PoseState | None = None
    imm: ImmState | None = None
    updated_ns: int = 0
    recent_updates: deque[Update] = field(default_factory=deque)
    recent_used: deque[int] = field(default_factory=deque)
    last_readings: dict[int, ExposureReadings] = field(default_factory=dict)
    sigma_px: Array | float = np.nan
    reliability: TrackReliability | None = None
    exposures_to_reliability: int = 0
    recent_residuals: deque[ExposureResiduals] = field(default_factory=deque)
    exposures: deque[MarkerExposure] = field(default_factory=deque)
    exposures_since_search: int = 0
    backoff: AcquisitionBackoff = field(default_factory=AcquisitionBackoff)
    fit_history: deque[bool] = field(default_factory=deque)
    exposures_to_confirm: int = 0
    lit_by_slot: dict[int | None, NDArray[np.intp]] = field(default_factory=dict)
    status: PoseStatus = PoseStatus.UNKNOWN
    reason: str = "no exposure could have shown it yet"
    _used: tuple[tuple[Update | None, int], UsedReadings] | None = field(default=None, init=False)
    _tested: tuple[tuple[object, ...], str | None] | None = field(default=None, init=False)

    def begin(self, state: PoseState, time_ns: int, exposures_to_confirm: int) -> None:
        """Begin a track.

        Args:
            state: the acquired state.
            time_ns: time of the latest readings [ns].
            exposures_to_confirm: number of exposures that must fit before it is reported.
        """
        self.state, self.updated_ns = state, time_ns
        self.imm = self._initial_imm(state)
        self.exposures_to_confirm = exposures_to_confirm
        self.exposures_to_reliability = 0
        self.fit_history.clear()
        self._forget_readings()

    def continue_from(self, before: "ToolTrack") -> "ToolTrack":
        """Return the track of another tracker's same tool with the kernel of this one."""
        track = replace(
            before,
            body=self.body,
            imm_model=self.imm_model,
            kernel=self.kernel,
            backoff=self.backoff,
        )
        for name in _HISTORIES:
            setattr(track, name, deque(getattr(before, name)))
        track.last_readings = dict(before.last_readings)
        if before.imm is not None and before.imm.model is not self.imm_model:
            track.imm = track._initial_imm(before.imm.combined)
        return track

    def _initial_imm(self, state: PoseState) -> ImmState | None:
        return None if self.imm_model is None else ImmState.of(state, self.imm_model)

    @cached_property
    def centred(self) -> CentredMarkers:
        """The markers relative to their centroid."""
        return CentredMarkers.of(self.body)

    def lit(self, marker: int | None) -> NDArray[np.intp]:
        """Return the indices of the markers that an exposure lights."""
        if marker not in self.lit_by_slot:
            slots = self.body.strobe_markers or [None] * len(self.body)
            lit = [index for index, slot in enumerate(slots) if marker in (None, slot)]
            self.lit_by_slot[marker] = np.array(lit, dtype=np.intp)
        return self.lit_by_slot[marker]

    def predict_observation(
        self,
        time_ns: int,
        marker: int | None,
        motion: MotionSettings,
        manoeuvre_factor: float = 1.0,
        step: Step | None = None,
    ) -> ToolObservation:
        """Return the predicted tool in an exposure, without associated peaks.

        Args:
            time_ns: time of the exposure [ns].
            marker: strobe slot that is lit; None: all markers.
            motion: RMS accelerations.
            manoeuvre_factor: factor on the accelerations.
            step: result of the kernel, with these accelerations; None: without the kernel.
        """
        assert self.state is not None
        lit = self.lit(marker)
        if self.imm is None:
            state = predict(self.state, time_ns, motion, manoeuvre_factor)
            return ToolObservation(self.centred, lit, state)
        if len(lit) == 0:
            return ToolObservation(self.centred, lit, self.imm.predict_combined(time_ns))
        imm = self.imm.predict(time_ns, manoeuvre_factor) if step is None else step.predicted
        return ToolObservation(self.centred, lit, imm.widest_state, imm, step)

    def step_to(self, marker: int, manoeuvre_factor: float = 1.0) -> ToolStep | None:
        """Return what takes the tool to an exposure by the kernel; None: it has none, or is lost.

        Args:
            marker: strobe slot that is lit.
            manoeuvre_factor: factor on the accelerations.
        """
        if self.kernel is None or self.imm is None:
            return None
        lit = self.lit(marker)
        return ToolStep(self.kernel, self.imm, int(lit[0]) if len(lit) else None, manoeuvre_factor)

    def commit(self, observation: ToolObservation) -> None:
        """Continue from the state after an exposure."""
        self.state = observation.state
        if observation.imm is not None:
            self.imm, self.state = observation.imm, observation.imm.combined

    def drop(self, status: PoseStatus, reason: str) -> None:
        """End the track.

        Args:
            status: status of the lost tool.
            reason: the same in words.
        """
        if not self.exposures_to_confirm:
            self.backoff.reset()
        self.state = self.imm = None
        self._forget_readings()
        self.exposures.clear()
        self.fit_history.clear()
        if status is not PoseStatus.INVALID:
            # A tool that is found again after a misfit must fit for a while first.
            self.recent_residuals.clear()
        self.exposures_since_search = self.exposures_to_confirm = 0
        self.status, self.reason = status, reason

    @property
    def used(self) -> UsedReadings:
        """The readings that the pose is based on."""
        updates = self.recent_updates
        # Most exposures of a strobe light other tools.
        of = updates[-1] if updates else None, len(updates)
        if self._used is None or self._used[0][0] is not of[0] or self._used[0][1] != of[1]:
            self._used = of, UsedReadings.of(updates, self.sensors)
        return self._used[1]

    @property
    def used_mask(self) -> NDArray[np.bool_]:
        """Which sensor read which marker in these, shape (M, S)."""
        return unpack_mask(self.used.which, (len(self.body), self.sensors))

    def check_consistency(
        self,
        observation: ToolObservation,
        marker: int | None,
        measurements: Measurements,
        model: MeasurementModel,
        free: Callable[[], Measurements],
        gate_probability: float,
    ) -> None:
        """Check an exposure's readings against the prediction, and record the residuals.

        An association that contradicts the exposure is rolled back.

        Args:
            observation: the tool in this exposure, after association.
            marker: strobe slot that was lit; None: all markers.
            measurements: the frame's peaks.
            model: the cameras.
            free: returns the peaks that no tool has taken; called only where needed.
            gate_probability: probability that a correct reading is outside the gate.
        """
        if len(observation.lit) == 0:
            return
        square, count = 0.0, 0
        excluded: NDArray[np.intp] | None = None
        missed = observation.readings < observation.peaks.size
        if missed:
            off = observation.excluded_nis(model, free(), gate_probability)
            count = int(np.count_nonzero(off))
        if count:
            square = float(off.sum())
            excluded = np.zeros(len(self.body), dtype=np.intp)
            excluded[observation.lit] = (off > 0.0).sum(axis=1)
        if marker is None:
            against = observation.count_contradictions(free().usable.sum(axis=1)) if missed else 0
            if against and against >= observation.readings > 0:
                square, count = MAX_EXCLUDED_NIS * against, against
                observation.roll_back()
        elif missed and observation.readings < WEAK_FRACTION * (
            measurements.usable.any(axis=1).sum()
        ):
            # Only this marker was lit, and most peaks are not where it must be: the few that fit
            # do so by chance. The misfit is recorded, so no residuals are needed.
            square, count = 0.0, 0
            observation.roll_back()
        markers = len(self.body)
        if observation.readings + count:
            parts = observation.whitened
            whitened = np.concatenate(parts) if len(parts) > 1 else parts[0] if parts else None
            residuals = ExposureResiduals(
                observation.nis + square, observation.readings + count, excluded, whitened
            )
            cycle = 1 if marker is None else markers
            _append(self.recent_residuals, residuals, CONSISTENCY_CYCLES * cycle)
        fits = observation.readings > 0 or not observation.misfit
        _append(self.fit_history, fits, ACQUISITION_CYCLES * markers)
        self.exposures_to_confirm = max(0, self.exposures_to_confirm - (observation.readings > 0))

    def inconsistency(self, probability: float) -> str | None:
        """Return why its readings do not fit, the excluded ones included; None: they fit.

        All readings of its last exposures are tested, over one cycle of its markers and over
        CONSISTENCY_CYCLES: the readings of a bent marker are excluded frame after frame, and the
        rest agrees with a wrong pose.

        Args:
            probability: probability that correct readings are rejected.
        """
        residuals = self.recent_residuals
        newest = residuals[-1] if residuals else None
        # Most exposures of a strobe light other tools.
        of = newest, len(residuals), len(self.recent_updates), probability
        if self._tested is None or self._tested[0] != of:
            self._tested = of, self._test_consistency(probability)
        return self._tested[1]

    def _test_consistency(self, probability: float) -> str | None:
        often = [one.excluded > 0 for one in self.recent_residuals if one.excluded is not None]
        if len(often) >= EXCLUSION_COUNT_THRESHOLD:
            exposures = np.sum(often, axis=0)
            one_cycle = len(self.recent_residuals) <= CONSISTENCY_CYCLES
            times = len(often) if one_cycle else exposures.max()
            if times >= EXCLUSION_COUNT_THRESHOLD:
                return (
                    f"marker {exposures.argmax() + 1} does not fit the tool's geometry, or another "
                    f"does not: in {times} of its last {CONSISTENCY_CYCLES} exposures readings "
                    "were left out of the pose"
                )
        cycle = list(self.recent_residuals)[-max(1, len(self.recent_updates)) :]
        # The calibration error is the same in all exposures: it does not average out.
        for of in (cycle,) if self.common_errors else (cycle, self.recent_residuals):
            square, count, limit = chi2_test(of, probability)
            if square > limit:
                return (
                    f"its last {count} readings do not fit it: their residuals are "
                    f"{(square / count) ** 0.5:.3g} standard deviations RMS; at most "
                    f"{(limit / count) ** 0.5:.3g} are allowed"
                )
        return None

    @property
    def is_refuted(self) -> bool:
        """Whether the last exposures contradict the tracked pose."""
        if self.exposures_to_confirm:
            return not all(self.fit_history)
        return self.fit_history.count(False) >= len(self.body)

    def is_weak(self, observation: ToolObservation) -> bool:
        """Return whether a frame has so few readings that the tool may have manoeuvred."""
        if len(observation.lit) == 0:
            return False
        usual = max((readings for _, readings, _ in self.recent_updates), default=0)
        return observation.misfit or observation.readings < WEAK_FRACTION * usual

    def current_reliability(self, model: MeasurementModel, significance: float) -> PoseReliability:
        """Return the reliability of the pose by the readings of its last CONSISTENCY_CYCLES.

        Those over which its readings are tested too, so that a marker that is hidden for a moment
        does not count as gone. Taken as of one time and without the prediction, which a wrong
        reading that lasts has drawn along. Once in a cycle of its markers it is computed anew,
        where other readings are used or the tool has moved.

        Args:
            model: the cameras.
            significance: of the chi-square test.
        """
        assert self.state is not None
        reliability, state = self.reliability, self.state
        if reliability is not None and self.exposures_to_reliability > 0:
            self.exposures_to_reliability -= 1
            return reliability.value
        self.exposures_to_reliability = len(self.body) - 1
        which = reduce(or_, self.recent_used, 0)
        if reliability is not None and reliability.holds(state, which, self.centred.radius_mm):
            return reliability.value
        for readings in self.last_readings.values():
            self.keep_sigma(marker_readings(len(self.body), *readings)[1])
        used = unpack_mask(which, (len(self.body), self.sensors))
        sigma = np.where(np.isfinite(self.sigma_px), self.sigma_px, 1.0)
        pose = state.rotation, state.centroid_mm
        value = None
        if self.kernel is not None:
            value = self.kernel.reliability.of(used, sigma, *pose, significance)
        if value is None:
            equations = PoseEquations(model, self.centred, np.where(used, 0.0, np.nan), sigma)
            value = pose_reliability(equations, *pose, significance)
        self.reliability = TrackReliability(value, which, *pose)
        return value

    def keep_sigma(self, sigma_px: Array) -> None:
        """Keep the standard deviations of new readings, shape (M, S); NaN where there is none."""
        self.sigma_px = np.where(np.isfinite(sigma_px), sigma_px, self.sigma_px)

    def record_used(self, used: int, most: int) -> None:
        """Count the readings of an update among those of the last ones.

        Args:
            used: which sensor read which marker, packed.
            most: number of updates that count.
        """
        _append(self.recent_used, used, most)

    def _forget_readings(self) -> None:
        self.recent_updates.clear()
        self.recent_used.clear()
        self.last_readings = {}
        self.sigma_px = np.nan

    def record_update(
        self, observation: ToolObservation, time_ns: int, measurements: Measurements
    ) -> None:
        """Keep the last updates: one where all markers are lit, else one for each marker.

        Args:
            observation: the tool in this exposure, after association.
            time_ns: time of the exposure [ns].
            measurements: the frame's peaks.
        """
        lit, peaks = observation.lit, observation.peaks
        most, used = len(self.body), 0
        for row in range(len(lit)):
            first = self.sensors * int(lit[row])
            for sensor, peak in enumerate(peaks[row].tolist(), first):
                used |= (peak >= 0) << sensor
        if len(lit) == most:
            most = 1
        _append(self.recent_updates, (observation.nis, observation.readings, used), most)
        self.record_used(used, CONSISTENCY_CYCLES * most)
        self.last_readings[int(lit[0])] = lit, peaks, measurements
        self.updated_ns = time_ns


def _append(history: deque[T], item: T, most: int) -> None:
    """Append an item; the oldest of more than ``most`` are dropped."""
    history.append(item)
    while len(history) > most:
        history.popleft()
