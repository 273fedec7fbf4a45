"""PoseFeed: the newest poses for sessions, and waiting for newer ones."""

import asyncio
import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import Final

import numpy as np
from numpy.typing import NDArray

from service.api.tools.tip_limit import TipLimit
from service.pipeline.latest_poses import LatestPoses, PoseEntry
from service.protocols.ndi.pose_view import PoseView

AGE_S: Final = 0.5
"""Poses are not given any more when nothing has come for so long, nor for AGE_FRAMES frames; nor
when their exposures are older than twice as much."""
AGE_FRAMES: Final = 5.0

MarkersOf = Callable[[str, str], NDArray[np.float64] | None]
"""Returns the markers of a device's tool in its own coordinates [mm]; None: they are not known."""


GetTipLimits = Callable[[], Mapping[str, Mapping[str, TipLimit]]]
"""Returns the limits of all tools, by device, running or not, and the tool's id."""


def _none() -> Mapping[str, Mapping[str, TipLimit]]:
    return {}


def _unknown(_device: str, _tool: str) -> None:
    return None


class PoseFeed:
    """Made and used in the event loop.

    Args:
        board: where poses are put up.
        device: whose poses are given; None: those of the only device that has tools.
        markers: where a tool's markers are; by default they are not known.
        age_s: see AGE_S.
        now: a clock that never goes back [s].
        wall_ns: the clock of the exposures, as time.time_ns.
        known: all tools, those of devices that do not run, too; by default none.
    """

    def __init__(
        self,
        board: LatestPoses,
        device: str | None = None,
        markers: MarkersOf = _unknown,
        age_s: float = AGE_S,
        now: Callable[[], float] = time.monotonic,
        wall_ns: Callable[[], int] = time.time_ns,
        known: GetTipLimits = _none,
    ) -> None:
        self._board = board
        self._chosen = device
        self._markers = markers
        self._age_s = age_s
        self._now = now
        self._wall_ns = wall_ns
        self._known = known
        self._came: dict[str, float] = dict.fromkeys(board.newest(), now())
        self._waiting: set[asyncio.Event] = set()
        self._end = board.listen(self._told)

    def look(self, device: str | None) -> PoseView:
        """Return what a session sees: of this device; None: of the one that has tools.

        Tools of a device that does not run are there, without poses.
        """
        newest = self._board.newest()
        wanted = device or self._chosen
        if wanted is None:
            having = [name for name, entry in newest.items() if entry.poses]
            having = having or [name for name, tools in self._known().items() if tools]
            if len(having) != 1:
                return PoseView(several=len(having) > 1)
            wanted = having[0]
        entry = newest.get(wanted)
        if entry is None:
            tools = tuple(sorted(self._known().get(wanted, ())))
            return PoseView(wanted, tools=tools, markers=partial(self._markers, wanted))
        fresh = self._fresh(entry)
        return PoseView(
            device_id=wanted,
            tools=tuple(sorted(entry.poses)),
            poses=entry.poses if fresh else {},
            sequence=entry.sequence,
            fresh=fresh,
            frame_rate_hz=entry.frame_rate_hz,
            markers=partial(self._markers, wanted),
            limits=self._known().get(wanted, {}),
        )

    async def newer(self, device: str | None, sequence: int, patience_s: float) -> None:
        """Return once there are poses of another frame, or patience has ended."""
        end = self._now() + patience_s
        news = asyncio.Event()
        self._waiting.add(news)
        try:
            while self.look(device).sequence == sequence:
                news.clear()
                async with asyncio.timeout(max(0.0, end - self._now())):
                    await news.wait()
        except TimeoutError:
            pass
        finally:
            self._waiting.discard(news)

    def close(self) -> None:
        """Listen no longer."""
        self._end()

    def _told(self, entry: PoseEntry) -> None:
        self._came[entry.device_id] = self._now()
        for news in self._waiting:
            news.set()

    def _fresh(self, entry: PoseEntry) -> bool:
        # What was put up before we listened, or is not told of yet, counts from when it is seen.
        came = self._came.setdefault(entry.device_id, self._now())
        slow = AGE_FRAMES / entry.frame_rate_hz if entry.frame_rate_hz > 0.0 else 0.0
        max_age_s = max(self._age_s, slow)
        # Exposures tell of a pipeline that is behind; their clock may be set while we look.
        old_s = (self._wall_ns() - entry.exposure_ns) * 1e-9
        return self._now() - came <= max_age_s and old_s <= 2.0 * max_age_s
