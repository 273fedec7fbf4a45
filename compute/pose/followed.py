"""Followed: a tool and what a tracker knows of it from frame to frame."""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.pose.association import LEFT_OUT_MOST, FramePeaks, Look
from compute.pose.marker_frame import MarkerFrame
from compute.pose.native.strobed_step import StrobedStep
from compute.pose.offered import Offered, judged
from compute.pose.pose_filter import PoseState, predict
from compute.pose.pose_report import Support
from compute.pose.reading_model import ReadingModel
from compute.pose.regimes import Regimes
from compute.pose.rigid_body import RigidBody
from compute.pose.search_pause import SearchPause
from compute.pose.settings import MotionSettings
from compute.pose.strobed_start import Exposure
from compute.pose.tool_pose import PoseStatus

CYCLES: Final = 2
"""Exposures of each marker that a strobed tool is found from."""
OFFERED_CYCLES: Final = 4
"""Exposures of each marker over which all readings that were offered are judged, also those that
were left out of the pose."""
OFTEN: Final = 3
"""Of the exposures of OFFERED_CYCLES: readings left out so often do not fit by more than chance."""
WEAK_SHARE: Final = 0.5
"""A frame that finds fewer than this share of the readings of the frame before is tried again with
a manoeuvre."""


@dataclass(eq=False)
class Followed:
    """A tool and what is known of it.

    Args:
        body: its markers.
        errors: number of common errors of its filter.
        step: follows it through plain exposures; None: it has no regimes, or there is no kernel.
        state: of its filter at the last frame; None: it is lost.
        regimes: of a strobed tool's motion, at its last exposure; None: it has a single one.
        seen_ns: when readings last updated it.
        last: its last updates: time, NIS, readings, which markers and sensors (M, S).
        offered: what the readings of its last exposures are off.
        exposures: the last exposures of a strobed tool that is lost.
        fresh: exposures since it was last looked for in vain.
        pause: when it is looked for again, a strobed one.
        fits: whether its last exposures fitted it.
        to_confirm: exposures that must fit, in a row, before a strobed tool that was just found is
            believed: it may have been found from a false peak.
        lights: which of its markers an exposure lights, as far as asked.
        status: of a lost tool.
        reason: why it is lost.
    """

    body: RigidBody
    errors: int
    step: StrobedStep | None = None
    state: PoseState | None = None
    regimes: Regimes | None = None
    seen_ns: int = 0
    last: deque[tuple[float, int, NDArray[np.bool_]]] = field(default_factory=deque)
    offered: deque[Offered] = field(default_factory=deque)
    exposures: deque[Exposure] = field(default_factory=deque)
    fresh: int = 0
    pause: SearchPause = field(default_factory=SearchPause)
    fits: deque[bool] = field(default_factory=deque)
    to_confirm: int = 0
    lights: dict[int | None, NDArray[np.intp]] = field(default_factory=dict)
    status: PoseStatus = PoseStatus.UNKNOWN
    reason: str = "no exposure could have shown it yet"

    @property
    def frame(self) -> MarkerFrame:
        """Its markers about their centroid."""
        return MarkerFrame.of(self.body)

    def lit(self, marker: int | None) -> NDArray[np.intp]:
        """Return which of its markers an exposure lights."""
        known = self.lights.get(marker)
        if known is None:
            slots = self.body.strobe_markers or ()
            one = [slots.index(marker)] if marker in slots else []
            every = range(len(self.body))
            known = self.lights[marker] = np.array(every if marker is None else one, dtype=np.intp)
        return known

    def look(
        self,
        time_ns: int,
        marker: int | None,
        motion: MotionSettings,
        manoeuvre: float = 1.0,
        seen: FramePeaks | None = None,
    ) -> Look:
        """Return where it is expected in an exposure; nothing is found there yet.

        Args:
            time_ns: of the exposure [ns].
            marker: strobe slot that is lit; None: all markers.
            motion: of tools.
            manoeuvre: factor on the accelerations.
            seen: the peaks, which a kernel may then look at at once; None: it is not to.
        """
        assert self.state is not None
        lit = self.lit(marker)
        if self.regimes is None:
            return Look(self.frame, lit, predict(self.state, time_ns, motion, manoeuvre))
        if len(lit) == 0:
            if self.step is not None and seen is not None:
                return Look(self.frame, lit, self.step.ahead(self.regimes, time_ns))
            return Look(self.frame, lit, self.regimes.ahead(time_ns))
        if self.step is not None and seen is not None and len(lit) == 1:
            step = self.step.take(self.regimes, time_ns, int(lit[0]), seen, manoeuvre)
            return Look(self.frame, lit, step.predicted.widest, step.predicted, step)
        regimes = self.regimes.predict(time_ns, manoeuvre)
        return Look(self.frame, lit, regimes.widest, regimes)

    def take(self, look: Look) -> None:
        """Go on from what an exposure showed."""
        self.state = look.state
        if look.regimes is not None:
            self.regimes, self.state = look.regimes, look.regimes.whole

    def lose(self, status: PoseStatus, reason: str) -> None:
        """Forget where it is, and keep why."""
        self.state = self.regimes = None
        self.last.clear()
        self.exposures.clear()
        self.fits.clear()
        if status is not PoseStatus.INVALID:
            # A tool that is found again although it does not fit has to fit for a while first.
            self.offered.clear()
        self.fresh = self.to_confirm = 0
        self.status, self.reason = status, reason

    @cached_property
    def _none_left(self) -> NDArray[np.intp]:
        """That of no marker anything was left out, shape (M,); not to be written to."""
        return np.zeros(len(self.body), dtype=np.intp)

    def support(self) -> Support:
        """Return what its last updates rest on."""
        nis, readings, sensors = zip(*self.last, strict=True)
        seen = sensors[0].copy()
        for one in sensors[1:]:
            seen |= one
        return Support(nis, readings, seen)

    def judge(
        self,
        look: Look,
        marker: int | None,
        seen: FramePeaks,
        model: ReadingModel,
        free: Callable[[], FramePeaks],
        gate_probability: float,
    ) -> None:
        """Note whether what an exposure showed is what it must have shown.

        ``free`` tells the peaks that are no tool's, where that is asked.
        """
        if len(look.lit) == 0:
            return
        square, count = 0.0, 0
        of_markers = self._none_left
        if look.readings < look.peaks.size:
            off = look.left_out(model, free(), gate_probability)
            count = int(np.count_nonzero(off))
        if count:
            square = float(off.sum())
            of_markers = np.zeros(len(self.body), dtype=np.intp)
            of_markers[look.lit] = (off > 0.0).sum(axis=1)
        if marker is None:
            missed = look.readings < look.peaks.size
            against = look.contradictions(free().usable.sum(axis=1)) if missed else 0
            if against and against >= look.readings > 0:
                square, count = LEFT_OUT_MOST * against, against
                look.reject()
        elif look.readings < WEAK_SHARE * seen.usable.any(axis=1).sum():
            # The marker alone was lit, and most of what was seen is not where it must be: what
            # little fits does so by chance. That it did not fit is noted, which says enough.
            square, count = 0.0, 0
            look.reject()
        if look.readings + count:
            whitened = np.concatenate(look.whitened) if look.whitened else None
            one = Offered(look.nis + square, look.readings + count, of_markers, whitened)
            self._offer(one, marker)
        self.fits.append(look.readings > 0 or not look.misfit)
        self.to_confirm = max(0, self.to_confirm - (look.readings > 0))
        while len(self.fits) > CYCLES * len(self.body):
            self.fits.popleft()

    def _offer(self, one: Offered, marker: int | None) -> None:
        """Keep what the readings that an exposure offered are off."""
        self.offered.append(one)
        cycle = 1 if marker is None else len(self.body)
        while len(self.offered) > OFFERED_CYCLES * cycle:
            self.offered.popleft()

    def unfit(self, probability: float) -> str | None:
        """Return that its readings do not fit it, those that were left out of it as well.

        All that its last exposures offered is judged, of one cycle of its markers and of
        OFFERED_CYCLES: a marker that is bent has its readings left out frame after frame, and what
        is left agrees with a pose that is wrong.

        Args:
            probability: chance that right readings are taken for wrong ones.
        """
        often = [one.left_out > 0 for one in self.offered if one.leaves]
        exposures = np.sum(often, axis=0) if often else self._none_left
        whole = len(self.offered) <= OFFERED_CYCLES
        times = len(often) if whole else exposures.max()
        if times >= OFTEN:
            return (
                f"marker {exposures.argmax() + 1} does not fit the tool's geometry, or another "
                f"does not: in {times} of its last {OFFERED_CYCLES} exposures readings were left "
                "out of the pose"
            )
        cycle = list(self.offered)[-max(1, len(self.last)) :]
        # An error of the calibration is the same in all of them: they do not average it away.
        for of in (cycle,) if self.errors else (cycle, self.offered):
            square, count, limit = judged(of, probability)
            if square > limit:
                return (
                    f"its last {count} readings do not fit it: they are "
                    f"{(square / count) ** 0.5:.3g} deviations off, RMS; "
                    f"{(limit / count) ** 0.5:.3g} is the most"
                )
        return None

    @property
    def refuted(self) -> bool:
        """Whether what the last exposures showed is not where the tool is believed to be."""
        if self.to_confirm:
            return not all(self.fits)
        return self.fits.count(False) >= len(self.body)

    def is_weak(self, look: Look) -> bool:
        """Return whether a frame found so little that the tool may have moved unexpectedly."""
        if len(look.lit) == 0:
            return False
        usual = max((readings for _, readings, _ in self.last), default=0)
        return look.misfit or look.readings < WEAK_SHARE * usual

    def count(self, look: Look, time_ns: int) -> None:
        """Keep what the last frames contributed: one where all markers are lit, else one each."""
        sensors = np.zeros((len(self.body), look.peaks.shape[1]), dtype=np.bool_)
        sensors[look.lit] = look.peaks >= 0
        most = 1 if len(look.lit) == len(self.body) else len(self.body)
        self.last.append((look.nis, look.readings, sensors))
        while len(self.last) > most:
            self.last.popleft()
        self.seen_ns = time_ns
