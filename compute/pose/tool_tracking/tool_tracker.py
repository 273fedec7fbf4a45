"""ToolTracker: poses of all tools of a device, exposure by exposure, and why a tool has none."""

from collections.abc import Sequence
from copy import deepcopy
from functools import cache, partial
from math import sqrt
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.camera.model import SensorModel
from compute.camera.stack import CameraStack
from compute.errors import InvalidParameter
from compute.mapping.table import CorrectionTable
from compute.measurement.measurement_model import MeasurementModel
from compute.measurement.measurements import Measurements, check_sensors
from compute.pose.estimation.observability import unobservable_motion
from compute.pose.filtering.association import ToolObservation, associate, without_peaks
from compute.pose.filtering.imm import ImmModel
from compute.pose.filtering.native.kernel_arguments import has_kernel
from compute.pose.filtering.native.strobed_step import (
    FrameSteps,
    Step,
    StrobedStepKernel,
)
from compute.pose.filtering.pose_filter import PoseState, ReportedPose
from compute.pose.rigid_body import CentredMarkers, PoseStatus, RigidBody, ToolPose
from compute.pose.settings import ToolTrackerSettings
from compute.pose.tool_tracking.exposure_history import StaleDataDetector, StrobeCycle
from compute.pose.tool_tracking.tool_search import ToolSearch
from compute.pose.tool_tracking.tool_track import COAST_CYCLES, ToolTrack
from compute.reconstruction.point_batch import PointBatch
from compute.reconstruction.solver import term_capacity

Array = NDArray[np.float64]

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
        self._frame_steps: FrameSteps | None = None
        if any(tool.kernel is not None for tool in self._tools):
            self._frame_steps = FrameSteps(len(self.model), term_capacity(self.model.cameras))
        self._search = ToolSearch(self.model, self.settings)
        self._time_ns: int | None = None
        self._stale_data = StaleDataDetector()
        self._cycle = StrobeCycle()

    @property
    def tools(self) -> tuple[RigidBody, ...]:
        """The tools, in the order of the poses."""
        return tuple(tool.body for tool in self._tools)

    def reset(self) -> None:
        """End all tracks; needed where time goes back."""
        self._tools = [
            ToolTrack(tool.body, tool.sensors, tool.common_errors, tool.imm_model, tool.kernel)
            for tool in self._tools
        ]
        self._time_ns = None
        self._stale_data = StaleDataDetector()
        self._cycle = StrobeCycle()

    def adopt_state(self, other: "ToolTracker") -> None:
        """Take over the tracks of the same tools from another tracker of the same cameras."""
        tools_by_name = {tool.body.name: tool for tool in other._tools}
        for index, tool in enumerate(self._tools):
            before = tools_by_name.get(tool.body.name)
            if (
                before is not None
                and before.common_errors == tool.common_errors
                and np.array_equal(before.body.markers_mm, tool.body.markers_mm)
                and before.body.strobe_markers == tool.body.strobe_markers
            ):
                self._tools[index] = tool.continue_from(before)
        self._time_ns = other._time_ns
        self._cycle = deepcopy(other._cycle)

    def _untracked(self, body: RigidBody, common_errors: int) -> ToolTrack:
        """Return the track of a lost tool."""
        if body.strobe_markers is None or len(self._imm_model) == 1:
            return ToolTrack(body, len(self.model), common_errors)
        kernel = None
        if has_kernel(self.model, self._imm_model):
            kernel = StrobedStepKernel(
                self.model,
                self._imm_model,
                CentredMarkers.of(body),
                common_errors,
                self.settings.gate_probability,
            )
        return ToolTrack(body, len(self.model), common_errors, self._imm_model, kernel)

    def step(
        self,
        time_ns: int,
        sequence: int,
        measurements: Measurements,
        marker: int | None,
        points: PointBatch | None = None,
        exposure_ns: int | None = None,
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
            exposure_ns: the same time on the clock of the poses' users [ns]; None: ``time_ns``.

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
        self._acquire(time_ns, marker, measurements, observations, points)
        of_frame = time_ns if exposure_ns is None else exposure_ns, sequence
        return tuple([self._report(tool, time_ns, of_frame) for tool in self._tools])

    def _track(
        self, time_ns: int, marker: int | None, measurements: Measurements
    ) -> dict[int, ToolObservation]:
        """Predict and update the tracked tools; end tracks without readings for too long."""
        observations: dict[int, ToolObservation] = {}
        steps = self._take_steps(time_ns, marker, measurements)
        for index, tool in enumerate(self._tools):
            if tool.state is None:
                continue
            step = steps.get(index)
            if isinstance(step, PoseState):
                observation, state = None, step
            else:
                observation = tool.predict_observation(
                    time_ns, marker, self.settings.motion, step=step
                )
                state = observation.state
            unseen_ns = time_ns - tool.updated_ns
            if unseen_ns > 1e9 * self.settings.coast_s and unseen_ns > self._coast_ns(tool):
                # No frame, or none with readings of it, for too long: it must be acquired again.
                self._drop(tool, state)
            elif observation is None:
                # Most exposures of a strobe light other tools.
                tool.state = state
            else:
                observations[index] = observation
        associate(
            self.model,
            observations.values(),
            measurements,
            self.settings.gate_probability,
            self.settings.resolution_px,
        )
        self._retry_manoeuvring(observations, time_ns, marker, measurements)
        # As it is before one of them rolls back; worked out only where it is needed.
        taken = [observation.peaks for observation in observations.values()]
        free = cache(partial(without_peaks, measurements, taken))
        for index, observation in observations.items():
            tool = self._tools[index]
            tool.check_consistency(
                observation, marker, measurements, self.model, free, self.settings.gate_probability
            )
            tool.commit(observation)
            if observation.readings:
                tool.record_update(observation, time_ns, measurements)
            if tool.is_refuted:
                tool.drop(PoseStatus.INVALID, MISFIT)
        return observations

    def _take_steps(
        self, time_ns: int, marker: int | None, measurements: Measurements
    ) -> dict[int, Step | PoseState]:
        """Take the strobed tools to an exposure, in one launch: those that have a kernel."""
        if marker is None or self._frame_steps is None:
            return {}
        jobs = {index: tool.step_to(marker) for index, tool in enumerate(self._tools)}
        found = {index: job for index, job in jobs.items() if job is not None}
        if not found:
            return {}
        steps = self._frame_steps.take(tuple(found.values()), time_ns, measurements)
        return dict(zip(found, steps, strict=True))

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
        others = [one.peaks for index, one in observations.items() if index not in weak]
        free = without_peaks(measurements, others)
        factor = motion.manoeuvre_factor
        trials = {}
        for index in weak:
            tool, step = self._tools[index], None
            job = None if marker is None else tool.step_to(marker, factor)
            if job is not None and self._frame_steps is not None:
                (step,) = self._frame_steps.take((job,), time_ns, free)
            assert not isinstance(step, PoseState)
            trials[index] = tool.predict_observation(time_ns, marker, motion, factor, step)
        associate(
            self.model,
            trials.values(),
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
        elif (departure := self._departure_reason(tool, state)) is not None:
            tool.drop(PoseStatus.OUT_OF_VIEW, f"{departure}; {coast}")
        else:
            tool.drop(PoseStatus.MISSING, coast)

    def _departure_reason(self, tool: ToolTrack, state: PoseState) -> str | None:
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
        lost: list[ToolTrack] = []
        tracked: list[ToolObservation] = []
        for index, tool in enumerate(self._tools):
            observation = None if tool.state is None else observations.get(index)
            if marker is None and (observation is None or not observation.readings):
                lost.append(tool)
            elif observation is not None:
                tracked.append(observation)
            elif len(lit := tool.lit(marker)):
                cycle_ns = self._cycle.duration_ns(tool.body.strobe_markers)
                starting = measurements.only(measurements.can_initiate)
                self._search.strobed(tool, time_ns, int(lit[0]), starting, cycle_ns)
        if lost:
            starting = measurements.only(measurements.can_initiate)
            self._search.simultaneous(lost, time_ns, starting, tracked, points)

    def _report(self, tool: ToolTrack, time_ns: int, of_frame: tuple[int, int]) -> ToolPose:
        """Return the pose of a tool, or the reason why there is none.

        Args:
            tool: the tool.
            time_ns: time of the frame [ns].
            of_frame: its time and number as its users know them.
        """
        name, state = tool.body.name, tool.state
        if state is None:
            return ToolPose(name, tool.status, tool.reason, *of_frame)
        pose, used = state.reported_pose(tool.centred), tool.used
        missing = self._missing(tool, state, pose, time_ns)
        if missing is not None:
            return ToolPose(name, *missing, *of_frame)
        tip_sd = sqrt(pose.tip_variance_mm2)
        limit = tool.body.max_tip_sd_mm
        if limit is None:
            limit = self.settings.max_tip_sd_mm
        status, reason = PoseStatus.OK, self._outside_volume(tool, state)
        unknown = self._beyond_table(tool, state)
        if unknown is not None:
            status, reason = PoseStatus.OUT_OF_VOLUME, unknown
        elif tip_sd > limit:
            status = PoseStatus.HIGH_ERROR
            reason = (
                f"the tip's standard deviation is {tip_sd:.3g} mm, of {used.readings} readings of "
                f"{used.markers} of {len(tool.body)} markers; at most {limit:.3g} mm is allowed"
            )
        elif reason is not None:
            status = PoseStatus.OUT_OF_VOLUME
        reliability = tool.current_reliability(
            self.model, self.settings.fit.false_rejection_probability
        )
        most = self.settings.fit.max_detectable_sigma
        if status is PoseStatus.OK and most is not None and reliability.detectable_sigma > most:
            status, reason = PoseStatus.LOW_RELIABILITY, reliability.low_reason(most)
        return ToolPose(
            name,
            status,
            reason,
            *of_frame,
            pose.rotation,
            pose.translation_mm,
            pose.covariance if unknown is None else None,
            pose.tip_mm,
            pose.tip_covariance_mm2 if unknown is None else None,
            used.residual_sigma,
            used.markers,
            used.readings,
            pose.velocity_mm_s,
            pose.angular_velocity_rad_s,
            time_ns - tool.updated_ns,
            reliability.detectable_sigma,
            reliability.external_tip_mm,
            reliability.external_rotation_rad,
        )

    def _missing(
        self, tool: ToolTrack, state: PoseState, pose: ReportedPose, time_ns: int
    ) -> tuple[PoseStatus, str] | None:
        """Return status and reason of a tracked tool without a usable pose; None: it has one."""
        if self._stale_data.is_stale(tool.body.strobe_markers):
            return PoseStatus.INVALID, STALE_DATA_MESSAGE
        if False in tool.fit_history and not all(list(tool.fit_history)[-len(tool.body) :]):
            return PoseStatus.INVALID, MISFIT
        unseen_ms = 1e-6 * (time_ns - tool.updated_ns)
        if unseen_ms > 1e3 * self.settings.coast_s:
            cycle_ms = 1e-6 * self._cycle.duration_ns(tool.body.strobe_markers)
            return PoseStatus.MISSING, (
                f"nothing was seen of it for {unseen_ms:.3g} ms; its markers' turn to be lit comes "
                f"every {cycle_ms:.3g} ms"
            )
        if tool.exposures_to_confirm and tool.status is PoseStatus.INVALID:
            return tool.status, tool.reason
        if tool.exposures_to_confirm:
            return PoseStatus.MISSING, (
                f"it was just found; {tool.exposures_to_confirm} more exposure"
                f"{'' if tool.exposures_to_confirm == 1 else 's'} must fit before it is believed"
            )
        inconsistency = tool.inconsistency(self.settings.fit.false_rejection_probability)
        if inconsistency is not None:
            return PoseStatus.INVALID, inconsistency
        unobservable = self._unobservable(tool, state, pose)
        if unobservable is None:
            return None
        departure = self._departure_reason(tool, state)
        if departure is not None:
            return PoseStatus.OUT_OF_VIEW, departure
        return PoseStatus.MISSING, unobservable

    def _unobservable(self, tool: ToolTrack, state: PoseState, pose: ReportedPose) -> str | None:
        """Return which motion the readings do not determine; None: they determine all."""
        centred, fit = tool.centred, self.settings.fit
        most = (fit.max_sigma_fraction * centred.radius_mm) ** 2
        # The trace bounds the largest eigenvalue and is much cheaper: it is checked first.
        if pose.pose_variance_mm2 <= most:
            return None
        covariance = state.covariance[:6, :6]
        radius = np.array([centred.radius_mm] * 3 + [1.0] * 3)
        scaled = covariance * (radius[:, None] * radius)
        if np.linalg.eigvalsh(scaled)[-1] <= most:
            return None
        reason = unobservable_motion(np.linalg.inv(scaled), centred, tool.used_mask, fit)
        return reason or "the readings do not determine the pose"

    def _beyond_table(self, tool: ToolTrack, state: PoseState) -> str | None:
        """Return why a pose has no covariance: markers beyond the correction table; None: it has.

        A pose that is predicted counts by all markers.
        """
        if self.model.corrections is None:
            return None
        beyond, used = ~self.model.in_box(state.marker_positions(tool.centred)), tool.used_mask
        if used.any():
            beyond &= used.any(axis=1)
        if not beyond.any():
            return None
        names = [f"marker {index + 1}" for index in range(len(beyond))]
        return (
            f"{_listed(names, np.flatnonzero(beyond))} beyond the correction table: how certain "
            "the pose is is not known"
        )

    def _outside_volume(self, tool: ToolTrack, state: PoseState) -> str | None:
        """Return which part of a tool is outside the calibrated volume or the table's hull."""
        if self.settings.volume_mm is None and self.model.corrections is None:
            return None
        markers = state.marker_positions(tool.centred)
        names = [f"marker {index + 1}" for index in range(len(markers))]
        if self.settings.volume_mm is not None:
            low, high = np.array(self.settings.volume_mm)
            tip = state.centroid_mm + state.rotation @ tool.centred.tip_mm
            parts = np.vstack([tip, markers])
            beyond = np.flatnonzero(((parts < low) | (parts > high)).any(axis=1))
            if len(beyond):
                return (
                    f"{_listed(['the tip', *names], beyond)} outside of the volume of the "
                    f"calibration, at {_position(parts[beyond[0]])}; it reaches from "
                    f"{_position(low)} to {_position(high)}"
                )
        if self.model.corrections is not None:
            used = tool.used_mask
            outside = np.flatnonzero((used & ~self.model.inside_hull(markers)).any(axis=1))
            if len(outside):
                return f"{_listed(names, outside)} where the correction table is not valid"
        return None


def _listed(names: Sequence[str], which: NDArray[np.intp]) -> str:
    *first, last = (names[index] for index in which)
    return f"{', '.join(first)} and {last} are" if first else f"{last} is"


def _position(position_mm: Array) -> str:
    return "(" + ", ".join(f"{value:.0f}" for value in position_mm) + ") mm"
