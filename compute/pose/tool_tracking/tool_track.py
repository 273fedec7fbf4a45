"""ToolTrack: the state of one tool between exposures."""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.measurement.measurement_model import MeasurementModel
from compute.measurement.measurements import Measurements
from compute.pose.acquisition.acquisition_backoff import AcquisitionBackoff
from compute.pose.acquisition.acquisition_strobed import MarkerExposure
from compute.pose.centred_markers import CentredMarkers
from compute.pose.filtering.association import MAX_EXCLUDED_NIS, ToolObservation
from compute.pose.filtering.imm_state import ImmState
from compute.pose.filtering.native.strobed_step import StrobedStepKernel
from compute.pose.filtering.pose_filter import PoseState, predict
from compute.pose.rigid_body import RigidBody
from compute.pose.settings import MotionSettings
from compute.pose.tool_pose import PoseStatus
from compute.pose.tool_tracking.consistency import ExposureResiduals, chi2_test
from compute.pose.tool_tracking.pose_report import TrackSupport

ACQUISITION_CYCLES: Final = 2
"""Exposures of each marker that a strobed tool is found from."""
CONSISTENCY_CYCLES: Final = 4
"""Exposures of each marker over which all readings that were offered are judged, also those that
were left out of the pose."""
EXCLUSION_COUNT_THRESHOLD: Final = 3
"""Of the exposures of OFFERED_CYCLES: readings left out so often do not fit by more than chance."""
WEAK_FRACTION: Final = 0.5
"""A frame that finds fewer than this share of the readings of the frame before is tried again with
a manoeuvre."""


@dataclass(eq=False)
class ToolTrack:
    """A tool and what is known of it.

    Args:
        body: its markers.
        common_errors: number of common errors of its filter.
        step: follows it through plain exposures; None: it has no modes, or there is no kernel.
        state: of its filter at the last frame; None: it is lost.
        imm: of a strobed tool's motion, at its last exposure; None: it has a single one.
        updated_ns: when readings last updated it.
        recent_updates: its last updates: time, NIS, readings, which markers and sensors (M, S).
        recent_residuals: what the readings of its last exposures are off.
        exposures: the last exposures of a strobed tool that is lost.
        exposures_since_search: exposures since it was last looked for in vain.
        backoff: when it is looked for again, a strobed one.
        fit_history: whether its last exposures fitted it.
        exposures_to_confirm: exposures that must fit, in a row, before a strobed tool that was just
            found is believed: it may have been found from a false peak.
        lit_by_slot: which of its markers an exposure lights, as far as asked.
        status: of a lost tool.
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
        """Its markers about their centroid."""
        return CentredMarkers.of(self.body)

    def lit(self, marker: int | None) -> NDArray[np.intp]:
        """Return which of its markers an exposure lights."""
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
        """Return where it is expected in an exposure; nothing is found there yet.

        Args:
            time_ns: of the exposure [ns].
            marker: strobe slot that is lit; None: all markers.
            motion: of tools.
            manoeuvre_factor: factor on the accelerations.
            measurements: the peaks, which a kernel may then look at at once; None: it is not to.
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
        """Go on from what an exposure showed."""
        self.state = observation.state
        if observation.imm is not None:
            self.imm, self.state = observation.imm, observation.imm.combined

    def drop(self, status: PoseStatus, reason: str) -> None:
        """Forget where it is, and keep why."""
        self.state = self.imm = None
        self.recent_updates.clear()
        self.exposures.clear()
        self.fit_history.clear()
        if status is not PoseStatus.INVALID:
            # A tool that is found again although it does not fit has to fit for a while first.
            self.recent_residuals.clear()
        self.exposures_since_search = self.exposures_to_confirm = 0
        self.status, self.reason = status, reason

    @cached_property
    def _none_excluded(self) -> NDArray[np.intp]:
        """That of no marker anything was left out, shape (M,); not to be written to."""
        return np.zeros(len(self.body), dtype=np.intp)

    def support(self) -> TrackSupport:
        """Return what its last updates rest on."""
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
        """Note whether what an exposure showed is what it must have shown.

        ``free`` tells the peaks that are no tool's, where that is asked.
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
            # The marker alone was lit, and most of what was seen is not where it must be: what
            # little fits does so by chance. That it did not fit is noted, which says enough.
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
        """Keep what the readings that an exposure offered are off."""
        self.recent_residuals.append(one)
        cycle = 1 if marker is None else len(self.body)
        while len(self.recent_residuals) > CONSISTENCY_CYCLES * cycle:
            self.recent_residuals.popleft()

    def inconsistency(self, probability: float) -> str | None:
        """Return that its readings do not fit it, those that were left out of it as well.

        All that its last exposures offered is judged, of one cycle of its markers and of
        CONSISTENCY_CYCLES: a marker that is bent has its readings left out frame after frame, and
        what is left agrees with a pose that is wrong.

        Args:
            probability: chance that right readings are taken for wrong ones.
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
        # An error of the calibration is the same in all of them: they do not average it away.
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
        """Whether what the last exposures showed is not where the tool is believed to be."""
        if self.exposures_to_confirm:
            return not all(self.fit_history)
        return self.fit_history.count(False) >= len(self.body)

    def is_weak(self, observation: ToolObservation) -> bool:
        """Return whether a frame found so little that the tool may have moved unexpectedly."""
        if len(observation.lit) == 0:
            return False
        usual = max((readings for _, readings, _ in self.recent_updates), default=0)
        return observation.misfit or observation.readings < WEAK_FRACTION * usual

    def record_update(self, observation: ToolObservation, time_ns: int) -> None:
        """Keep what the last frames contributed: one where all markers are lit, else one each."""
        sensors = np.zeros((len(self.body), observation.peaks.shape[1]), dtype=np.bool_)
        sensors[observation.lit] = observation.peaks >= 0
        most = 1 if len(observation.lit) == len(self.body) else len(self.body)
        self.recent_updates.append((observation.nis, observation.readings, sensors))
        while len(self.recent_updates) > most:
            self.recent_updates.popleft()
        self.updated_ns = time_ns
