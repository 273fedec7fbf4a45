"""ToolTracker: poses of all tools of a device, frame by frame, each with what it is worth."""

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
from compute.pose.association import LEFT_OUT_MOST, FramePeaks, Look, associate
from compute.pose.followed import CYCLES, Followed
from compute.pose.frozen_image import FrozenImage
from compute.pose.lit_start import find_lit
from compute.pose.marker_frame import MarkerFrame
from compute.pose.native.strobed_step import StrobedStep, can_step
from compute.pose.offered import Offered
from compute.pose.pose_filter import PoseState
from compute.pose.pose_report import outside_volume, report, without_pose
from compute.pose.reading_model import ReadingModel
from compute.pose.regime_model import RegimeModel
from compute.pose.regimes import Regimes
from compute.pose.rigid_body import RigidBody
from compute.pose.settings import ToolTrackerSettings
from compute.pose.strobe_cycle import StrobeCycle
from compute.pose.strobed_start import Exposure, find_strobed
from compute.pose.tool_pose import PoseStatus, ToolPose
from compute.reconstruction.estimate import PointBatch

Array = NDArray[np.float64]

LEAST_EXPOSURES: Final = 8
"""That are kept to find a strobed tool from: enough of three markers, too, that two sensors see."""
TURNS: Final = 1.25
"""Of the strobe, for which a tool is predicted at least: one, and some frames that are lost."""
FROZEN: Final = "the readings do not change by a single bit: the image is frozen"
MISFIT: Final = "the readings do not fit it where it was and how it moved"


class ToolTracker:
    """Poses of tools from the peaks of each frame; the same input gives the same poses.

    A tool that is tracked has a filter (``compute.pose.pose_filter``), which every reading of its
    markers updates, be they lit in turn or together. A strobed tool that is lost is found from the
    last exposures of its markers, one whose markers are lit together among reconstructed points.

    Args:
        cameras: S calibrated cameras, one by one or stacked.
        tools: with names that all differ.
        settings: limits and tolerances.
        parameter_covariance: joint covariance of the cameras' parameters, as of ``reconstruct``;
            None: taken as exact.
        corrections: correction table of the readings; None: none.
        pixels: number of pixels of each sensor, to tell what left the field; None: not known.

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
        self.model = ReadingModel.of(cameras, parameter_covariance, corrections)
        self.settings = settings or ToolTrackerSettings()
        names = [tool.name for tool in tools]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise InvalidParameter(f'two tools are named "{twice[0]}"; names must differ')
        if pixels is not None and len(pixels) != self.model.sensors:
            raise InvalidParameter(
                f"pixels are of {len(pixels)} sensors; there are {self.model.sensors} cameras"
            )
        self.pixels = pixels
        common = self.model.common.shape[2]
        table = 0 if corrections is None else self.model.sensors
        self._regimes = RegimeModel.of(self.settings.motion, self.settings.regimes)
        self._tools = [self._fresh(body, common + table * len(body)) for body in tools]
        self._time_ns: int | None = None
        self._image = FrozenImage()
        self._cycle = StrobeCycle()

    @property
    def tools(self) -> tuple[RigidBody, ...]:
        """The tools, in the order of the poses."""
        return tuple(tool.body for tool in self._tools)

    def reset(self) -> None:
        """Forget where all tools are; needed where time goes back."""
        self._tools = [Followed(tool.body, tool.errors, tool.step) for tool in self._tools]
        self._time_ns = None
        self._image = FrozenImage()
        self._cycle = StrobeCycle()

    def keep(self, other: "ToolTracker") -> None:
        """Go on with what another tracker of the same cameras knows of the same tools."""
        known = {tool.body.name: tool for tool in other._tools}
        for tool in self._tools:
            before = known.get(tool.body.name)
            if before is None or before.errors != tool.errors:
                continue
            same = np.array_equal(before.body.markers_mm, tool.body.markers_mm)
            if same and before.body.strobe_markers == tool.body.strobe_markers:
                tool.state, tool.seen_ns, tool.fresh = before.state, before.seen_ns, before.fresh
                tool.regimes = before.regimes
                if before.regimes is not None and before.regimes.model is not self._regimes:
                    tool.regimes = self._begun(tool, before.regimes.whole)
                tool.last, tool.fits = deque(before.last), deque(before.fits)
                tool.offered = deque(before.offered)
                tool.exposures, tool.to_confirm = deque(before.exposures), before.to_confirm
                tool.status, tool.reason = before.status, before.reason
        self._time_ns = other._time_ns
        self._cycle = other._cycle.copy()

    def _fresh(self, body: RigidBody, errors: int) -> Followed:
        """Return a tool of which nothing is known."""
        probability, step = self.settings.gate_probability, None
        if body.strobe_markers is not None and can_step(self.model, self._regimes):
            step = StrobedStep(self.model, self._regimes, MarkerFrame.of(body), errors, probability)
        return Followed(body, errors, step)

    def _begun(self, tool: Followed, state: PoseState) -> Regimes | None:
        """Return the regimes of a tool of which a state is known; None: it needs no more than it.

        Markers that are lit together tell the pose in every frame: how it moves adds little.
        """
        if tool.body.strobe_markers is None or len(self._regimes) == 1:
            return None
        return Regimes.of(state, self._regimes)

    def step(
        self,
        time_ns: int,
        sequence: int,
        position_px: Array,
        sigma_px: Array,
        peak_flags: NDArray[np.int32],
        marker: int | None,
        points: PointBatch | None = None,
    ) -> tuple[ToolPose, ...]:
        """Return the pose of every tool at a frame.

        Args:
            time_ns: middle of the exposure [ns], not before that of the frame before.
            sequence: number of the frame.
            position_px: peaks of each sensor, shape (S, K) [px]; NaN where there are fewer than K.
            sigma_px: their standard deviations, shape (S, K) [px].
            peak_flags: PeakFlag values, shape (S, K).
            marker: strobe slot that was lit; None: all markers.
            points: points reconstructed of this frame, to find tools by their geometry; None: none.

        Raises:
            InvalidParameter: time goes back, or the peaks are of another number of sensors.
        """
        if self._time_ns is not None and time_ns < self._time_ns:
            raise InvalidParameter(
                f"the frame at {time_ns} ns comes after that at {self._time_ns} ns; call reset() "
                "where time goes back"
            )
        if position_px.ndim != 2 or len(position_px) != self.model.sensors:
            raise InvalidParameter(
                f"position_px has the shape {position_px.shape}; it must be "
                f"({self.model.sensors}, K)"
            )
        self._time_ns = time_ns
        self._image.see(marker, position_px, sigma_px)
        seen = FramePeaks.of(position_px, sigma_px, peak_flags)
        looks = self._follow(time_ns, marker, seen)
        self._cycle.see(marker, time_ns)
        self._find(time_ns, marker, seen, looks, points)
        return tuple(self._report(tool, time_ns, sequence) for tool in self._tools)

    def _follow(self, time_ns: int, marker: int | None, seen: FramePeaks) -> dict[int, Look]:
        """Predict and update the tools that are tracked; drop those not seen for too long."""
        looks: dict[int, Look] = {}
        for index, tool in enumerate(self._tools):
            if tool.state is None:
                continue
            look = tool.look(time_ns, marker, self.settings.motion, seen=seen)
            unseen_ns = time_ns - tool.seen_ns
            if unseen_ns > 1e9 * self.settings.coast_s and unseen_ns > self._coast_ns(tool):
                # Not a frame came for so long, or none that showed it: it is found anew.
                self._drop(tool, look.state)
                continue
            looks[index] = look
        associate(
            self.model,
            list(looks.values()),
            seen,
            self.settings.gate_probability,
            self.settings.merge_px,
        )
        self._again(looks, time_ns, marker, seen)
        found = list(looks.values())
        # Of several before one of them gives back what it has taken; of one where it is asked for.
        rest = seen.without(found) if len(found) > 1 else None
        free = partial(seen.without, found) if rest is None else lambda: rest
        for index, look in looks.items():
            tool = self._tools[index]
            tool.judge(look, marker, seen, self.model, free, self.settings.gate_probability)
            tool.take(look)
            if look.readings:
                tool.count(look, time_ns)
            if tool.refuted:
                tool.lose(PoseStatus.INVALID, MISFIT)
        return looks

    def _again(
        self,
        looks: dict[int, Look],
        time_ns: int,
        marker: int | None,
        seen: FramePeaks,
    ) -> None:
        """Try tools that moved as they were not expected to again, with a manoeuvre."""
        weak = [index for index, look in looks.items() if self._tools[index].is_weak(look)]
        if not weak:
            return
        motion = self.settings.motion
        others = [look for index, look in looks.items() if index not in weak]
        free = seen.without(others)
        trials = {
            index: self._tools[index].look(time_ns, marker, motion, motion.manoeuvre)
            for index in weak
        }
        associate(
            self.model,
            list(trials.values()),
            free,
            self.settings.gate_probability,
            self.settings.merge_px,
        )
        for index, trial in trials.items():
            if trial.readings > looks[index].readings:
                looks[index] = trial

    def _coast_ns(self, tool: Followed) -> float:
        """Return how long a tool is predicted: until the turn of its markers has gone by."""
        turn_ns = TURNS * self._cycle.of(tool.body.strobe_markers)
        return max(1e9 * self.settings.coast_s, turn_ns)

    def _drop(self, tool: Followed, state: PoseState) -> None:
        """Give a tool up that was predicted for too long, and say where it went."""
        coast = f"nothing was seen of it for {1e-6 * self._coast_ns(tool):.3g} ms"
        if tool.fits and not tool.fits[-1]:
            tool.lose(PoseStatus.INVALID, MISFIT)
            return
        left = self._left_view(tool, state)
        if left is not None:
            tool.lose(PoseStatus.OUT_OF_VIEW, f"{left}; {coast}")
        else:
            tool.lose(PoseStatus.MISSING, coast)

    def _left_view(self, tool: Followed, state: PoseState) -> str | None:
        """Return that too few of a tool's readings would be on the pixels, if so."""
        if self.pixels is None:
            return None
        value = self.model.expected(state.places(tool.frame))[0]
        here = (value >= -0.5) & (value <= np.array(self.pixels) - 0.5)
        if here.sum() >= self.settings.fit.least_readings:
            return None
        return (
            f"it left the sensors' fields: {int(here.sum())} of its {here.size} readings would be "
            "on the pixels where it was heading"
        )

    def _find(
        self,
        time_ns: int,
        marker: int | None,
        seen: FramePeaks,
        looks: dict[int, Look],
        points: PointBatch | None,
    ) -> None:
        """Look for the tools that are lost, or were not seen where they were expected."""
        together = []
        taken = []
        for index, tool in enumerate(self._tools):
            look = looks.get(index)
            lit = tool.lit(marker)
            if marker is None and (tool.state is None or look is None or not look.readings):
                together.append(tool)
            elif tool.state is not None and look is not None:
                taken.append(look)
                if not tool.to_confirm:
                    tool.pause.forget()
            elif len(lit):
                self._expose(tool, time_ns, int(lit[0]), seen)
        if together:
            self._identify(together, time_ns, seen, taken, points)

    def _expose(self, tool: Followed, time_ns: int, marker: int, seen: FramePeaks) -> None:
        """Keep an exposure of a lost strobed tool, and find it when there are enough."""
        pause = tool.pause
        before = list(tool.exposures)[-len(tool.body) :]
        if len(before) == len(tool.body) and not any(one.shows for one in before):
            pause.forget()  # all of its markers were hidden
        tool.exposures.append(Exposure(time_ns, marker, *seen.single()))
        most = max(CYCLES * len(tool.body), LEAST_EXPOSURES)
        turns_ns = round(CYCLES * TURNS * self._cycle.of(tool.body.strobe_markers))
        window_ns = max(round(1e9 * self.settings.window_s), turns_ns)
        oldest = time_ns - window_ns
        while tool.exposures[0].time_ns < oldest or len(tool.exposures) > most:
            tool.exposures.popleft()
        tool.fresh += 1
        pause.passed()
        shown = [one for one in tool.exposures if one.shows]
        markers = len({one.marker for one in shown})
        if not shown and tool.status is PoseStatus.OUT_OF_VIEW:
            return
        if not shown or not (pause.waits or tool.status is PoseStatus.INVALID):
            tool.status = PoseStatus.MISSING
            tool.reason = (
                f"{markers} of {len(tool.body)} markers were seen in the last "
                f"{1e-6 * window_ns:.3g} ms"
            )
        # After a failure a cycle goes by: the same exposures would fail again.
        if tool.fresh < len(tool.body) or not shown or shown[-1].time_ns != time_ns:
            return
        readings = sum(int(np.isfinite(one.readings_px).sum()) for one in shown)
        if not pause.due(time_ns, readings):
            return
        found = find_strobed(self.model, tool.frame, shown, tool.errors, self.settings)
        if found.searched:
            # In vain until it is confirmed. Too few readings may be enough with the next exposure.
            too_few = found.state is None and not found.unfit
            pause.failed(time_ns, readings, 1 if too_few else len(tool.body))
        if found.state is None:
            tool.fresh = 0 if found.unfit else tool.fresh
            tool.status = PoseStatus.INVALID if found.unfit else PoseStatus.MISSING
            tool.reason = str(found.reason)
            return
        tool.state, tool.seen_ns = found.state, time_ns
        tool.regimes = self._begun(tool, found.state)
        tool.to_confirm = len(tool.body)
        tool.exposures.clear()
        tool.fits.clear()
        tool.last.clear()
        sensors = np.zeros((len(tool.body), self.model.sensors), dtype=np.bool_)
        for one in shown:
            sensors[one.marker] = np.isfinite(one.readings_px)
        tool.last.append((found.nis, found.readings, sensors))
        nothing = np.zeros(len(tool.body), dtype=np.intp)
        tool.offered.append(Offered(found.nis, found.readings, nothing))

    def _identify(
        self,
        lost: list[Followed],
        time_ns: int,
        seen: FramePeaks,
        taken: list[Look],
        points: PointBatch | None,
    ) -> None:
        """Find lost tools whose markers are lit together among this frame's points."""
        found = find_lit(
            self.model,
            [tool.body for tool in lost],
            [tool.errors for tool in lost],
            time_ns,
            seen.without(taken),
            taken,
            points,
            self.settings,
        )
        for tool, one in zip(lost, found, strict=True):
            if one.state is None and tool.state is not None:
                continue
            if one.state is None:
                nothing = one.seen == 0 and tool.status is PoseStatus.OUT_OF_VIEW
                if not nothing:
                    tool.status, tool.reason = one.status, one.reason
                continue
            tool.state, tool.seen_ns, tool.to_confirm = one.state, time_ns, 0
            tool.regimes = self._begun(tool, one.state)
            tool.fits.clear()
            tool.last.clear()
            tool.last.append((one.nis, int(one.sensors.sum()), one.sensors))
            off = one.nis + LEFT_OUT_MOST * int(one.left_out.sum())
            number = int(one.sensors.sum() + one.left_out.sum())
            tool.offered.append(Offered(off, number, one.left_out))

    def _report(self, tool: Followed, time_ns: int, sequence: int) -> ToolPose:
        if tool.state is None:
            return without_pose(tool.body, tool.status, tool.reason, time_ns, sequence)
        if self._image.of(tool.body.strobe_markers):
            return without_pose(tool.body, PoseStatus.INVALID, FROZEN, time_ns, sequence)
        if not all(list(tool.fits)[-len(tool.body) :]):
            return without_pose(tool.body, PoseStatus.INVALID, MISFIT, time_ns, sequence)
        unseen_ms = 1e-6 * (time_ns - tool.seen_ns)
        if unseen_ms > 1e3 * self.settings.coast_s:
            turn_ms = 1e-6 * self._cycle.of(tool.body.strobe_markers)
            reason = (
                f"nothing was seen of it for {unseen_ms:.3g} ms; its markers' turn to be lit comes "
                f"every {turn_ms:.3g} ms"
            )
            return without_pose(tool.body, PoseStatus.MISSING, reason, time_ns, sequence)
        if tool.to_confirm and tool.status is PoseStatus.INVALID:
            return without_pose(tool.body, tool.status, tool.reason, time_ns, sequence)
        if tool.to_confirm:
            reason = (
                f"it was just found; {tool.to_confirm} more exposure"
                f"{'' if tool.to_confirm == 1 else 's'} must fit before it is believed"
            )
            return without_pose(tool.body, PoseStatus.MISSING, reason, time_ns, sequence)
        support = tool.support()
        unfit = tool.unfit(self.settings.fit.inconsistent_probability)
        if unfit is not None:
            return without_pose(tool.body, PoseStatus.INVALID, unfit, time_ns, sequence)
        outside = outside_volume(self.model, tool.body, tool.state, support, self.settings)
        pose = report(tool.body, tool.state, support, sequence, outside, self.settings)
        if pose.status is PoseStatus.MISSING:
            left = self._left_view(tool, tool.state)
            if left is not None:
                return without_pose(tool.body, PoseStatus.OUT_OF_VIEW, left, time_ns, sequence)
        unseen_ns = time_ns - tool.seen_ns
        return (
            pose if pose.rotation is None or not unseen_ns else replace(pose, unseen_ns=unseen_ns)
        )
