"""Followed: a tool and what a tracker knows of it from frame to frame."""

from collections import deque
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.pose.association import FramePeaks, Look
from compute.pose.marker_frame import MarkerFrame
from compute.pose.pose_filter import PoseState
from compute.pose.pose_report import Support
from compute.pose.rigid_body import RigidBody
from compute.pose.strobed_start import Exposure
from compute.pose.tool_pose import PoseStatus

CYCLES: Final = 2
"""Exposures of each marker that a strobed tool is found from."""
WEAK_SHARE: Final = 0.5
"""A frame that finds fewer than this share of the readings of the frame before is tried again with
a manoeuvre."""


@dataclass(eq=False)
class Followed:
    """A tool and what is known of it.

    Args:
        body: its markers.
        errors: number of common errors of its filter.
        state: of its filter; None: it is lost.
        seen_ns: when readings last updated it.
        last: its last updates: time, NIS, readings, which markers and sensors (M, S).
        exposures: the last exposures of a strobed tool that is lost.
        fresh: exposures since it was last looked for in vain.
        fits: whether its last exposures fitted it.
        to_confirm: exposures that must fit, in a row, before a strobed tool that was just found is
            believed: it may have been found from a false peak.
        status: of a lost tool.
        reason: why it is lost.
    """

    body: RigidBody
    errors: int
    state: PoseState | None = None
    seen_ns: int = 0
    last: deque[tuple[float, int, NDArray[np.bool_]]] = field(default_factory=deque)
    exposures: deque[Exposure] = field(default_factory=deque)
    fresh: int = 0
    fits: deque[bool] = field(default_factory=deque)
    to_confirm: int = 0
    status: PoseStatus = PoseStatus.UNKNOWN
    reason: str = "no exposure could have shown it yet"

    @property
    def frame(self) -> MarkerFrame:
        """Its markers about their centroid."""
        return MarkerFrame.of(self.body)

    def lit(self, marker: int | None) -> NDArray[np.intp]:
        """Return which of its markers an exposure lights."""
        if marker is None:
            return np.arange(len(self.body))
        slots = self.body.strobe_markers or ()
        return np.array([slots.index(marker)] if marker in slots else [], dtype=np.intp)

    def lose(self, status: PoseStatus, reason: str) -> None:
        """Forget where it is, and keep why."""
        self.state = None
        self.last.clear()
        self.exposures.clear()
        self.fits.clear()
        self.fresh = self.to_confirm = 0
        self.status, self.reason = status, reason

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
        free: NDArray[np.intp],
    ) -> None:
        """Note whether what an exposure showed is what it must have shown."""
        if len(look.lit) == 0:
            return
        if marker is None:
            if look.contradictions(free) > look.readings > 0:
                look.reject()
        elif look.readings < WEAK_SHARE * seen.usable.any(axis=1).sum():
            # The marker alone was lit, and most of what was seen is not where it must be: what
            # little fits does so by chance.
            look.reject()
        self.fits.append(look.readings > 0 or not look.misfit)
        self.to_confirm = max(0, self.to_confirm - (look.readings > 0))
        while len(self.fits) > CYCLES * len(self.body):
            self.fits.popleft()

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
