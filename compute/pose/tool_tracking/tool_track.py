"""ToolTrack: state of one tool between exposures; AcquisitionBackoff: intervals of its search."""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.measurement.measurement_model import MeasurementModel
from compute.measurement.measurements import Measurements
from compute.pose.acquisition.acquisition_strobed import MarkerExposure
from compute.pose.filtering.association import MAX_EXCLUDED_NIS, ToolObservation
from compute.pose.filtering.imm import ImmState
from compute.pose.filtering.native.strobed_step import StrobedStepKernel
from compute.pose.filtering.pose_filter import PoseState, predict
from compute.pose.rigid_body import CentredMarkers, RigidBody
from compute.pose.settings import MotionSettings
from compute.pose.tool_pose import PoseStatus
from compute.pose.tool_tracking.pose_report import ExposureResiduals, TrackSupport, chi2_test

MAX_DELAY_FRACTION: Final = 0.1
"""Largest delay by the pauses, as a fraction of the time of unsuccessful searches."""
MAX_PAUSE_NS: Final = 250_000_000
"""Longest pause between two searches."""


class AcquisitionBackoff:
    """Limits how often one lost strobed tool is searched for.

    A search costs as much as tracking twenty exposures or more. A tool that is seen well is found
    by the first, or soon; one with few and often false readings by the thirtieth; one whose
    readings never fit, because of a wrong calibration or another tool's markers, is searched for
    at growing intervals. The pauses grow in proportion to the time of unsuccessful searches, up to
    MAX_PAUSE_NS, so that waiting delays the acquisition by no more than that fraction. They restart
    when more readings are available than in any search before.
    """

    def __init__(self) -> None:
        """Start without any search."""
        self.reset()

    def reset(self) -> None:
        """Restart: the tool was found, or its readings changed."""
        self._first_ns: int | None = None  # of the searches in vain
        self._failed_ns = 0
        self._left = 0
        self._max_readings = -1

    @property
    def is_waiting(self) -> bool:
        """Whether a search failed since the last restart."""
        return self._first_ns is not None

    def count_exposure(self) -> None:
        """Count an exposure of the tool's markers."""
        self._left -= 1

    def due(self, time_ns: int, readings: int) -> bool:
        """Return whether to search now.

        Args:
            time_ns: time of the exposure [ns].
            readings: number of readings; more than in any search before are worth one.
        """
        if self._first_ns is None or readings > self._max_readings:
            return True
        pause_ns = time_ns - self._failed_ns
        enough_ns = MAX_DELAY_FRACTION * (self._failed_ns - self._first_ns)
        return pause_ns >= MAX_PAUSE_NS or (self._left <= 0 and pause_ns >= enough_ns)

    def record_failure(self, time_ns: int, readings: int, exposures: int) -> None:
        """Record an unsuccessful search.

        Args:
            time_ns: time of the latest exposure [ns].
            readings: number of readings that the search had.
            exposures: smallest number of exposures until the next search.
        """
        if self._first_ns is None or readings > self._max_readings:
            self._first_ns, self._max_readings = time_ns, readings
        self._failed_ns, self._left = time_ns, exposures


ACQUISITION_CYCLES: Final = 2
"""Number of exposures of each marker that a strobed tool is found from."""
CONSISTENCY_CYCLES: Final = 4
"""Number of exposures of each marker whose readings, excluded ones too, are tested together."""
EXCLUSION_COUNT_THRESHOLD: Final = 3
"""Number of exposures with excluded readings, in CONSISTENCY_CYCLES, that is more than chance."""
WEAK_FRACTION: Final = 0.5
"""A frame with fewer than this fraction of the last frame's readings is tried again with larger
accelerations."""


@dataclass(eq=False)
class ToolTrack:
    """A tool and the state of its tracking.

    Args:
        body: its markers.
        common_errors: number of common errors of its filter.
        step: kernel for unambiguous exposures; None: one motion model, or no kernel.
        state: state of its filter at the last frame; None: it is lost.
        imm: states of a strobed tool's motion models at its last exposure; None: there is one.
        updated_ns: time of the last readings [ns].
        recent_updates: its last updates: NIS, number of readings, markers and sensors (M, S).
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
    common_errors: int
    step: StrobedStepKernel | None = None
    state: PoseState | None = None
    imm: ImmState | None = None
    updated_ns: int = 0
    recent_updates: deque[tuple[float, int, NDArray[np.bool_]]] = field(default_factory=deque)
    recent_residuals: deque[ExposureResiduals] = field(default_factory=deque)
    exposures: deque[MarkerExposure] = field(default_factory=deque)
    exposures_since_search: int = 0
    backoff: AcquisitionBackoff = field(default_factory=AcquisitionBackoff)
    fit_history: deque[bool] = field(default_factory=deque)
    exposures_to_confirm: int = 0
    lit_by_slot: dict[int | None, NDArray[np.intp]] = field(default_factory=dict)
    status: PoseStatus = PoseStatus.UNKNOWN
    reason: str = "no exposure could have shown it yet"

    @property
    def centred(self) -> CentredMarkers:
        """The markers relative to their centroid."""
        return CentredMarkers.of(self.body)

    def lit(self, marker: int | None) -> NDArray[np.intp]:
        """Return the indices of the markers that an exposure lights."""
        known = self.lit_by_slot.get(marker)
        if known is None:
            slots = self.body.strobe_markers or ()
            one = [slots.index(marker)] if marker in slots else []
            every = range(len(self.body))
            known = self.lit_by_slot[marker] = np.array(
                every if marker is None else one, dtype=np.intp
            )
        return known

    def predict_observation(
        self,
        time_ns: int,
        marker: int | None,
        motion: MotionSettings,
        manoeuvre_factor: float = 1.0,
        measurements: Measurements | None = None,
    ) -> ToolObservation:
        """Return the predicted tool in an exposure, without associated peaks.

        Args:
            time_ns: time of the exposure [ns].
            marker: strobe slot that is lit; None: all markers.
            motion: RMS accelerations.
            manoeuvre_factor: factor on the accelerations.
            measurements: the peaks, for association by the kernel; None: without the kernel.
        """
        assert self.state is not None
        lit = self.lit(marker)
        if self.imm is None:
            return ToolObservation(
                self.centred, lit, predict(self.state, time_ns, motion, manoeuvre_factor)
            )
        if len(lit) == 0:
            if self.step is not None and measurements is not None:
                return ToolObservation(
                    self.centred, lit, self.step.predict_combined(self.imm, time_ns)
                )
            return ToolObservation(self.centred, lit, self.imm.predict_combined(time_ns))
        if self.step is not None and measurements is not None and len(lit) == 1:
            step = self.step.take(self.imm, time_ns, int(lit[0]), measurements, manoeuvre_factor)
            return ToolObservation(
                self.centred, lit, step.predicted.widest_state, step.predicted, step
            )
        imm = self.imm.predict(time_ns, manoeuvre_factor)
        return ToolObservation(self.centred, lit, imm.widest_state, imm)

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
        self.state = self.imm = None
        self.recent_updates.clear()
        self.exposures.clear()
        self.fit_history.clear()
        if status is not PoseStatus.INVALID:
            # A tool that is found again after a misfit must fit for a while first.
            self.recent_residuals.clear()
        self.exposures_since_search = self.exposures_to_confirm = 0
        self.status, self.reason = status, reason

    @cached_property
    def _none_excluded(self) -> NDArray[np.intp]:
        """No excluded reading of any marker, shape (M,); not to be written to."""
        return np.zeros(len(self.body), dtype=np.intp)

    def support(self) -> TrackSupport:
        """Return the readings that the pose is based on."""
        nis, readings, sensors = zip(*self.recent_updates, strict=True)
        used = sensors[0].copy()
        for one in sensors[1:]:
            used |= one
        return TrackSupport(nis, readings, used)

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
        of_markers = self._none_excluded
        if observation.readings < observation.peaks.size:
            off = observation.excluded_nis(model, free(), gate_probability)
            count = int(np.count_nonzero(off))
        if count:
            square = float(off.sum())
            of_markers = np.zeros(len(self.body), dtype=np.intp)
            of_markers[observation.lit] = (off > 0.0).sum(axis=1)
        if marker is None:
            missed = observation.readings < observation.peaks.size
            against = observation.count_contradictions(free().usable.sum(axis=1)) if missed else 0
            if against and against >= observation.readings > 0:
                square, count = MAX_EXCLUDED_NIS * against, against
                observation.roll_back()
        elif observation.readings < WEAK_FRACTION * measurements.usable.any(axis=1).sum():
            # Only this marker was lit, and most peaks are not where it must be: the few that fit
            # do so by chance. The misfit is recorded, so no residuals are needed.
            square, count = 0.0, 0
            observation.roll_back()
        if observation.readings + count:
            whitened = np.concatenate(observation.whitened) if observation.whitened else None
            one = ExposureResiduals(
                observation.nis + square, observation.readings + count, of_markers, whitened
            )
            self._keep_residuals(one, marker)
        self.fit_history.append(observation.readings > 0 or not observation.misfit)
        self.exposures_to_confirm = max(0, self.exposures_to_confirm - (observation.readings > 0))
        while len(self.fit_history) > ACQUISITION_CYCLES * len(self.body):
            self.fit_history.popleft()

    def _keep_residuals(self, one: ExposureResiduals, marker: int | None) -> None:
        """Keep the residuals of an exposure."""
        self.recent_residuals.append(one)
        cycle = 1 if marker is None else len(self.body)
        while len(self.recent_residuals) > CONSISTENCY_CYCLES * cycle:
            self.recent_residuals.popleft()

    def inconsistency(self, probability: float) -> str | None:
        """Return why its readings do not fit, the excluded ones included; None: they fit.

        All readings of its last exposures are tested, over one cycle of its markers and over
        CONSISTENCY_CYCLES: the readings of a bent marker are excluded frame after frame, and the
        rest agrees with a wrong pose.

        Args:
            probability: probability that correct readings are rejected.
        """
        often = [one.excluded > 0 for one in self.recent_residuals if one.any_excluded]
        exposures = np.sum(often, axis=0) if often else self._none_excluded
        one_cycle = len(self.recent_residuals) <= CONSISTENCY_CYCLES
        times = len(often) if one_cycle else exposures.max()
        if times >= EXCLUSION_COUNT_THRESHOLD:
            return (
                f"marker {exposures.argmax() + 1} does not fit the tool's geometry, or another "
                f"does not: in {times} of its last {CONSISTENCY_CYCLES} exposures readings were "
                "left out of the pose"
            )
        cycle = list(self.recent_residuals)[-max(1, len(self.recent_updates)) :]
        # The calibration error is the same in all exposures: it does not average out.
        for of in (cycle,) if self.common_errors else (cycle, self.recent_residuals):
            square, count, limit = chi2_test(of, probability)
            if square > limit:
                return (
                    f"its last {count} readings do not fit it: they are "
                    f"{(square / count) ** 0.5:.3g} deviations off, RMS; "
                    f"{(limit / count) ** 0.5:.3g} is the most"
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

    def record_update(self, observation: ToolObservation, time_ns: int) -> None:
        """Keep the last updates: one where all markers are lit, else one for each marker.

        Args:
            observation: the tool in this exposure, after association.
            time_ns: time of the exposure [ns].
        """
        sensors = np.zeros((len(self.body), observation.peaks.shape[1]), dtype=np.bool_)
        sensors[observation.lit] = observation.peaks >= 0
        most = 1 if len(observation.lit) == len(self.body) else len(self.body)
        self.recent_updates.append((observation.nis, observation.readings, sensors))
        while len(self.recent_updates) > most:
            self.recent_updates.popleft()
        self.updated_ns = time_ns
