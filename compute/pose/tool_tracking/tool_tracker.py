"""ToolTracker: poses of all tools of a device, exposure by exposure, and why a tool has none."""

from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.camera.model import SensorModel
from compute.camera.stack import CameraStack
from compute.errors import InvalidParameter
from compute.mapping.table import CorrectionTable
from compute.measurement.measurement_model import MeasurementModel
from compute.measurement.measurements import Measurements, check_sensors
from compute.pose.acquisition.acquisition_simultaneous import acquire_simultaneous
from compute.pose.acquisition.acquisition_strobed import MarkerExposure, acquire_strobed
from compute.pose.filtering.association import (
    MAX_EXCLUDED_NIS,
    ToolObservation,
    associate,
    without_tools,
)
from compute.pose.filtering.imm import ImmModel, ImmState
from compute.pose.filtering.native.strobed_step import StrobedStepKernel, has_kernel
from compute.pose.filtering.pose_filter import PoseState
from compute.pose.rigid_body import CentredMarkers, RigidBody
from compute.pose.settings import ToolTrackerSettings
from compute.pose.tool_pose import PoseStatus, ToolPose
from compute.pose.tool_tracking.exposure_history import StaleDataDetector, StrobeCycle
from compute.pose.tool_tracking.pose_report import (
    ExposureResiduals,
    missing_pose,
    outside_volume,
    report,
)
from compute.pose.tool_tracking.tool_track import ACQUISITION_CYCLES, ToolTrack
from compute.reconstruction.point_batch import PointBatch

Array = NDArray[np.float64]

MIN_EXPOSURES: Final = 8
"""Smallest number of exposures kept for acquisition: enough for three markers and two sensors."""
COAST_CYCLES: Final = 1.25
"""Shortest prediction without readings in strobe cycles: one, and some lost frames."""
STALE_DATA_MESSAGE: Final = "the readings do not change by a single bit: the image is frozen"
MISFIT: Final = "the readings do not fit it where it was and how it moved"


class ToolTracker:
    """Poses of tools from the peaks of each frame; deterministic.

    A tracked tool has a filter (``compute.pose.filtering.pose_filter``), which every reading of its
    markers updates, whether they are lit in turn or together. A lost strobed tool is found from the
    last exposures of its markers, one whose markers are lit together from reconstructed points.

    Args:
        cameras: S calibrated cameras, one by one or stacked.
        tools: tools with different names.
        settings: limits and tolerances.
        parameter_covariance: joint covariance of the cameras' parameters, as in ``reconstruct``;
            None: exact.
        corrections: correction table of the readings; None: none.
        pixels: number of pixels of each sensor, for OUT_OF_VIEW; None: unknown.

    Raises:
        InvalidParameter: two tools have one name, or ``pixels`` are of another number of sensors.
    """

    def __init__(
        self,
        cameras: CameraStack | Sequence[SensorModel],
        tools: Sequence[RigidBody],
        settings: ToolTrackerSettings | None = None,
        parameter_covariance: Array | None = None,
        corrections: CorrectionTable | None = None,
        pixels: tuple[int, ...] | None = None,
    ) -> None:
        self.model = MeasurementModel.of(cameras, parameter_covariance, corrections)
        self.settings = settings or ToolTrackerSettings()
        names = [tool.name for tool in tools]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise InvalidParameter(f'two tools are named "{twice[0]}"; names must differ')
        if pixels is not None and len(pixels) != len(self.model):
            raise InvalidParameter(
                f"pixels are of {len(pixels)} sensors; there are {len(self.model)} cameras"
            )
        self.pixels = pixels
        common = self.model.covariance_factor.shape[2]
        table = 0 if corrections is None else len(self.model)
        self._imm_model = ImmModel.of(self.settings.motion, self.settings.imm)
        self._tools = [self._untracked(body, common + table * len(body)) for body in tools]
        self._time_ns: int | None = None
        self._stale_data = StaleDataDetector()
        self._cycle = StrobeCycle()

    @property
    def tools(self) -> tuple[RigidBody, ...]:
        """The tools, in the order of the poses."""
        return tuple(tool.body for tool in self._tools)

    def reset(self) -> None:
        """End all tracks; needed where time goes back."""
        self._tools = [ToolTrack(tool.body, tool.common_errors, tool.step) for tool in self._tools]
        self._time_ns = None
        self._stale_data = StaleDataDetector()
        self._cycle = StrobeCycle()

    def adopt_state(self, other: "ToolTracker") -> None:
        """Take over the tracks of the same tools from another tracker of the same cameras."""
        known = {tool.body.name: tool for tool in other._tools}
        for tool in self._tools:
            before = known.get(tool.body.name)
            if before is None or before.common_errors != tool.common_errors:
                continue
            same = np.array_equal(before.body.markers_mm, tool.body.markers_mm)
            if same and before.body.strobe_markers == tool.body.strobe_markers:
                tool.state, tool.updated_ns, tool.exposures_since_search = (
                    before.state,
                    before.updated_ns,
                    before.exposures_since_search,
                )
                tool.imm = before.imm
                if before.imm is not None and before.imm.model is not self._imm_model:
                    tool.imm = self._initial_imm(tool, before.imm.combined)
                tool.recent_updates, tool.fit_history = (
                    deque(before.recent_updates),
                    deque(before.fit_history),
                )
                tool.recent_residuals = deque(before.recent_residuals)
                tool.exposures, tool.exposures_to_confirm = (
                    deque(before.exposures),
                    before.exposures_to_confirm,
                )
                tool.status, tool.reason = before.status, before.reason
        self._time_ns = other._time_ns
        self._cycle = other._cycle.copy()

    def _untracked(self, body: RigidBody, common_errors: int) -> ToolTrack:
        """Return the track of a lost tool."""
        probability, step = self.settings.gate_probability, None
        if body.strobe_markers is not None and has_kernel(self.model, self._imm_model):
            step = StrobedStepKernel(
                self.model, self._imm_model, CentredMarkers.of(body), common_errors, probability
            )
        return ToolTrack(body, common_errors, step)

    def _initial_imm(self, tool: ToolTrack, state: PoseState) -> ImmState | None:
        """Return the motion models of a tool with a known state; None: it needs one model only.

        Markers that are lit together determine the pose in every frame: motion models add little.
        """
        if tool.body.strobe_markers is None or len(self._imm_model) == 1:
            return None
        return ImmState.of(state, self._imm_model)

    def step(
        self,
        time_ns: int,
        sequence: int,
        measurements: Measurements,
        marker: int | None,
        points: PointBatch | None = None,
    ) -> tuple[ToolPose, ...]:
        """Return the pose of every tool at a frame.

        Args:
            time_ns: middle of the exposure [ns], not before that of the previous frame.
            sequence: number of the frame.
            measurements: peaks of the S sensors. Peaks that two markers may share are not used, as
                each peak goes to one marker at most; peaks that may not start a track only update
                tracked tools.
            marker: strobe slot that was lit; None: all markers.
            points: reconstructed points of this frame, for the identification of tools by their
                geometry; None: none.

        Raises:
            InvalidParameter: time goes back, or the peaks are of another number of sensors.
        """
        if self._time_ns is not None and time_ns < self._time_ns:
            raise InvalidParameter(
                f"the frame at {time_ns} ns comes after that at {self._time_ns} ns; call reset() "
                "where time goes back"
            )
        check_sensors(measurements, len(self.model))
        self._time_ns = time_ns
        self._stale_data.add_exposure(marker, measurements.position_px, measurements.sigma_px)
        if np.count_nonzero(measurements.shared):
            measurements = measurements.only(~measurements.shared)
        observations = self._track(time_ns, marker, measurements)
        self._cycle.add_exposure(marker, time_ns)
        starting = measurements.only(measurements.can_initiate)
        self._acquire(time_ns, marker, starting, observations, points)
        return tuple(self._report(tool, time_ns, sequence) for tool in self._tools)

    def _track(
        self, time_ns: int, marker: int | None, measurements: Measurements
    ) -> dict[int, ToolObservation]:
        """Predict and update the tracked tools; end tracks without readings for too long."""
        observations: dict[int, ToolObservation] = {}
        for index, tool in enumerate(self._tools):
            if tool.state is None:
                continue
            observation = tool.predict_observation(
                time_ns, marker, self.settings.motion, measurements=measurements
            )
            unseen_ns = time_ns - tool.updated_ns
            if unseen_ns > 1e9 * self.settings.coast_s and unseen_ns > self._coast_ns(tool):
                # No frame, or none with readings of it, for too long: it must be acquired again.
                self._drop(tool, observation.state)
                continue
            observations[index] = observation
        associate(
            self.model,
            list(observations.values()),
            measurements,
            self.settings.gate_probability,
            self.settings.resolution_px,
        )
        self._retry_manoeuvring(observations, time_ns, marker, measurements)
        found = list(observations.values())
        # With several tools, before one of them rolls back; with one, only where it is needed.
        rest = without_tools(measurements, found) if len(found) > 1 else None
        free = partial(without_tools, measurements, found) if rest is None else lambda: rest
        for index, observation in observations.items():
            tool = self._tools[index]
            tool.check_consistency(
                observation, marker, measurements, self.model, free, self.settings.gate_probability
            )
            tool.commit(observation)
            if observation.readings:
                tool.record_update(observation, time_ns)
            if tool.is_refuted:
                tool.drop(PoseStatus.INVALID, MISFIT)
        return observations

    def _retry_manoeuvring(
        self,
        observations: dict[int, ToolObservation],
        time_ns: int,
        marker: int | None,
        measurements: Measurements,
    ) -> None:
        """Predict tools with too few readings again, with the accelerations of a manoeuvre."""
        weak = [
            index
            for index, observation in observations.items()
            if self._tools[index].is_weak(observation)
        ]
        if not weak:
            return
        motion = self.settings.motion
        others = [observation for index, observation in observations.items() if index not in weak]
        free = without_tools(measurements, others)
        trials = {
            index: self._tools[index].predict_observation(
                time_ns, marker, motion, motion.manoeuvre_factor
            )
            for index in weak
        }
        associate(
            self.model,
            list(trials.values()),
            free,
            self.settings.gate_probability,
            self.settings.resolution_px,
        )
        for index, trial in trials.items():
            if trial.readings > observations[index].readings:
                observations[index] = trial

    def _coast_ns(self, tool: ToolTrack) -> float:
        """Return the longest prediction without readings: COAST_CYCLES of its strobe, or more."""
        turn_ns = COAST_CYCLES * self._cycle.duration_ns(tool.body.strobe_markers)
        return max(1e9 * self.settings.coast_s, turn_ns)

    def _drop(self, tool: ToolTrack, state: PoseState) -> None:
        """End the track of a tool that was predicted for too long, with the reason."""
        coast = f"nothing was seen of it for {1e-6 * self._coast_ns(tool):.3g} ms"
        if tool.fit_history and not tool.fit_history[-1]:
            tool.drop(PoseStatus.INVALID, MISFIT)
            return
        left = self._left_view(tool, state)
        if left is not None:
            tool.drop(PoseStatus.OUT_OF_VIEW, f"{left}; {coast}")
        else:
            tool.drop(PoseStatus.MISSING, coast)

    def _left_view(self, tool: ToolTrack, state: PoseState) -> str | None:
        """Return a reason where too few predicted readings are on the pixels; None: enough are."""
        if self.pixels is None:
            return None
        value = self.model.linearise(state.marker_positions(tool.centred))[0]
        here = (value >= -0.5) & (value <= np.array(self.pixels) - 0.5)
        if here.sum() >= self.settings.fit.min_readings:
            return None
        return (
            f"it left the sensors' fields: {int(here.sum())} of its {here.size} readings would be "
            "on the pixels where it was heading"
        )

    def _acquire(
        self,
        time_ns: int,
        marker: int | None,
        measurements: Measurements,
        observations: dict[int, ToolObservation],
        points: PointBatch | None,
    ) -> None:
        """Search for the tools that are lost or have no readings in this frame."""
        together = []
        taken = []
        for index, tool in enumerate(self._tools):
            observation = observations.get(index)
            lit = tool.lit(marker)
            if marker is None and (
                tool.state is None or observation is None or not observation.readings
            ):
                together.append(tool)
            elif tool.state is not None and observation is not None:
                taken.append(observation)
                if not tool.exposures_to_confirm:
                    tool.backoff.reset()
            elif len(lit):
                self._acquire_strobed(tool, time_ns, int(lit[0]), measurements)
        if together:
            self._acquire_simultaneous(together, time_ns, measurements, taken, points)

    def _acquire_strobed(
        self, tool: ToolTrack, time_ns: int, marker: int, measurements: Measurements
    ) -> None:
        """Keep an exposure of a lost strobed tool; search for it when there are enough."""
        backoff = tool.backoff
        before = list(tool.exposures)[-len(tool.body) :]
        if len(before) == len(tool.body) and not any(one.any_reading for one in before):
            backoff.reset()  # all of its markers were hidden
        tool.exposures.append(MarkerExposure(time_ns, marker, *measurements.unambiguous_readings()))
        most = max(ACQUISITION_CYCLES * len(tool.body), MIN_EXPOSURES)
        turns_ns = round(
            ACQUISITION_CYCLES * COAST_CYCLES * self._cycle.duration_ns(tool.body.strobe_markers)
        )
        window_ns = max(round(1e9 * self.settings.acquisition_window_s), turns_ns)
        oldest = time_ns - window_ns
        while tool.exposures[0].time_ns < oldest or len(tool.exposures) > most:
            tool.exposures.popleft()
        tool.exposures_since_search += 1
        backoff.count_exposure()
        shown = [one for one in tool.exposures if one.any_reading]
        markers = len({one.marker for one in shown})
        if not shown and tool.status is PoseStatus.OUT_OF_VIEW:
            return
        if not shown or not (backoff.is_waiting or tool.status is PoseStatus.INVALID):
            tool.status = PoseStatus.MISSING
            tool.reason = (
                f"{markers} of {len(tool.body)} markers were seen in the last "
                f"{1e-6 * window_ns:.3g} ms"
            )
        # Wait for a cycle after a failure: the same exposures would fail again.
        if (
            tool.exposures_since_search < len(tool.body)
            or not shown
            or shown[-1].time_ns != time_ns
        ):
            return
        readings = sum(int(np.isfinite(one.readings_px).sum()) for one in shown)
        if not backoff.due(time_ns, readings):
            return
        found = acquire_strobed(self.model, tool.centred, shown, tool.common_errors, self.settings)
        if found.searched:
            # A failure until it is confirmed. Too few readings may suffice with the next exposure.
            too_few = found.state is None and not found.inconsistent
            backoff.record_failure(time_ns, readings, 1 if too_few else len(tool.body))
        if found.state is None:
            tool.exposures_since_search = 0 if found.inconsistent else tool.exposures_since_search
            tool.status = PoseStatus.INVALID if found.inconsistent else PoseStatus.MISSING
            tool.reason = str(found.reason)
            return
        tool.state, tool.updated_ns = found.state, time_ns
        tool.imm = self._initial_imm(tool, found.state)
        tool.exposures_to_confirm = len(tool.body)
        tool.exposures.clear()
        tool.fit_history.clear()
        tool.recent_updates.clear()
        sensors = np.zeros((len(tool.body), len(self.model)), dtype=np.bool_)
        for one in shown:
            sensors[one.marker] = np.isfinite(one.readings_px)
        tool.recent_updates.append((found.nis, found.readings, sensors))
        nothing = np.zeros(len(tool.body), dtype=np.intp)
        tool.recent_residuals.append(ExposureResiduals(found.nis, found.readings, nothing))

    def _acquire_simultaneous(
        self,
        lost: list[ToolTrack],
        time_ns: int,
        measurements: Measurements,
        taken: list[ToolObservation],
        points: PointBatch | None,
    ) -> None:
        """Search for lost tools whose markers are lit together, among this frame's points."""
        found = acquire_simultaneous(
            self.model,
            [tool.body for tool in lost],
            [tool.common_errors for tool in lost],
            time_ns,
            without_tools(measurements, taken),
            taken,
            points,
            self.settings,
        )
        for tool, one in zip(lost, found, strict=True):
            if one.state is None and tool.state is not None:
                continue
            if one.state is None:
                nothing = one.point_count == 0 and tool.status is PoseStatus.OUT_OF_VIEW
                if not nothing:
                    tool.status, tool.reason = one.status, one.reason
                continue
            tool.state, tool.updated_ns, tool.exposures_to_confirm = one.state, time_ns, 0
            tool.imm = self._initial_imm(tool, one.state)
            tool.fit_history.clear()
            tool.recent_updates.clear()
            tool.recent_updates.append((one.nis, int(one.sensors.sum()), one.sensors))
            off = one.nis + MAX_EXCLUDED_NIS * int(one.excluded.sum())
            number = int(one.sensors.sum() + one.excluded.sum())
            tool.recent_residuals.append(ExposureResiduals(off, number, one.excluded))

    def _report(self, tool: ToolTrack, time_ns: int, sequence: int) -> ToolPose:
        if tool.state is None:
            return missing_pose(tool.body, tool.status, tool.reason, time_ns, sequence)
        if self._stale_data.is_stale(tool.body.strobe_markers):
            return missing_pose(
                tool.body, PoseStatus.INVALID, STALE_DATA_MESSAGE, time_ns, sequence
            )
        if not all(list(tool.fit_history)[-len(tool.body) :]):
            return missing_pose(tool.body, PoseStatus.INVALID, MISFIT, time_ns, sequence)
        unseen_ms = 1e-6 * (time_ns - tool.updated_ns)
        if unseen_ms > 1e3 * self.settings.coast_s:
            turn_ms = 1e-6 * self._cycle.duration_ns(tool.body.strobe_markers)
            reason = (
                f"nothing was seen of it for {unseen_ms:.3g} ms; its markers' turn to be lit comes "
                f"every {turn_ms:.3g} ms"
            )
            return missing_pose(tool.body, PoseStatus.MISSING, reason, time_ns, sequence)
        if tool.exposures_to_confirm and tool.status is PoseStatus.INVALID:
            return missing_pose(tool.body, tool.status, tool.reason, time_ns, sequence)
        if tool.exposures_to_confirm:
            reason = (
                f"it was just found; {tool.exposures_to_confirm} more exposure"
                f"{'' if tool.exposures_to_confirm == 1 else 's'} must fit before it is believed"
            )
            return missing_pose(tool.body, PoseStatus.MISSING, reason, time_ns, sequence)
        support = tool.support()
        inconsistency = tool.inconsistency(self.settings.fit.false_rejection_probability)
        if inconsistency is not None:
            return missing_pose(tool.body, PoseStatus.INVALID, inconsistency, time_ns, sequence)
        outside = outside_volume(self.model, tool.body, tool.state, support, self.settings)
        pose = report(tool.body, tool.state, support, sequence, outside, self.settings)
        if pose.status is PoseStatus.MISSING:
            left = self._left_view(tool, tool.state)
            if left is not None:
                return missing_pose(tool.body, PoseStatus.OUT_OF_VIEW, left, time_ns, sequence)
        unseen_ns = time_ns - tool.updated_ns
        return (
            pose if pose.rotation is None or not unseen_ns else replace(pose, unseen_ns=unseen_ns)
        )
