"""PoseFeed: the newest poses as sessions get them, and waiting for newer ones."""

import asyncio
import logging
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Final

import numpy as np
from anyio.to_thread import run_sync
from numpy.typing import NDArray
from sqlalchemy import select
from sqlalchemy.exc import SQLAlchemyError

from compute.errors import LumilineError
from compute.pose.rigid_body import PoseStatus, ToolPose
from service.api.tools.tip_limit import TipLimit, tip_limit_of
from service.database.engine import Database
from service.database.models import ToolRow
from service.pipeline.frame_batch import LatestPoses, PoseEntry

_REPORTED: Final = (PoseStatus.OK, PoseStatus.OUT_OF_VOLUME)
"""What a client can have, the latter if it asks for it."""
Markers = Callable[[str], NDArray[np.float64] | None]


@dataclass(frozen=True, eq=False)
class PoseView:
    """The tools of one device.

    Args:
        device_id: the device; None: there is none with tools yet, or it is not clear which.
        several: whether that is because several have tools, and no setting says which.
        tools: names of its tools, in order.
        poses: the newest poses by name; empty where they are old.
        sequence: number of the frame that they are of; -1: there is none.
        fresh: whether they are new.
        frame_rate_hz: of the device; 0: not known.
        markers: returns a tool's markers in its own coordinates, shape (M, 3) [mm]; None: they
            are not known.
        limits: on the error of poses, by the tool's name; tools without one are judged by the
            tracker only.
    """

    device_id: str | None = None
    several: bool = False
    tools: tuple[str, ...] = ()
    poses: Mapping[str, ToolPose] = field(default_factory=dict)
    sequence: int = -1
    fresh: bool = False
    frame_rate_hz: float = 0.0
    markers: Markers = lambda _: None
    limits: Mapping[str, TipLimit] = field(default_factory=dict)

    def pose(self, tool: str) -> ToolPose | None:
        """Return a tool's pose with the status that it has for a client; None: there is none.

        Besides the pose itself, the one relative to the tool's reference is judged: drivers are
        given both in the world, and form it from them. A reference of another status is
        not given, so that nothing can be formed with it.
        """
        pose, limit = self.poses.get(tool), self.limits.get(tool)
        if pose is None or limit is None:
            return pose
        if pose.status not in _REPORTED:
            return pose
        why = limit.exceeded_reason(pose)
        reference = None if limit.reference is None else self.poses.get(limit.reference)
        if why is None and reference is not None and reference.status in _REPORTED:
            why = limit.exceeded_reason(pose, reference)
        return pose if why is None else replace(pose, status=PoseStatus.HIGH_ERROR, reason=why)


GetPoseView = Callable[[str | None], PoseView]
"""Returns the view of a device; None: of the one that has tools."""


_log = logging.getLogger(__name__)

ASK_S: Final = 2.0
"""How often; which tools a device that runs has is known from its poses at once."""


class ToolCache:
    """Made and used in the event loop. While the database does not answer, what is known stays."""

    def __init__(self, database: Database) -> None:
        self._database = database
        self._tools: Mapping[str, Mapping[str, TipLimit]] = {}
        self._failing = False
        self._asking: asyncio.Task[None] | None = None

    def __call__(self) -> Mapping[str, Mapping[str, TipLimit]]:
        """Return the limits of tools by device and id, of devices that have any."""
        return self._tools

    async def start(self) -> None:
        """Ask, and go on asking."""
        await self.refresh()
        self._asking = asyncio.get_running_loop().create_task(self._ask())

    async def close(self) -> None:
        """Ask no longer."""
        if self._asking is not None:
            self._asking.cancel()
            with suppress(asyncio.CancelledError):
                await self._asking

    async def refresh(self) -> None:
        """Ask once."""
        try:
            self._tools = await run_sync(self._read)
        except (LumilineError, SQLAlchemyError) as error:
            if not self._failing:
                _log.warning("NDI clients: the tools are not known: %s", error)
            self._failing = True
            return
        self._failing = False

    async def _ask(self) -> None:
        while True:
            await asyncio.sleep(ASK_S)
            await self.refresh()

    def _read(self) -> Mapping[str, Mapping[str, TipLimit]]:
        limits: dict[str, dict[str, TipLimit]] = {}
        with self._database.read() as session:
            for tool in session.scalars(select(ToolRow)):
                limits.setdefault(tool.device_id, {})[tool.id] = tip_limit_of(session, tool)
        return limits


AGE_S: Final = 0.5
"""Poses are not given any more when nothing has come for so long, nor for AGE_FRAMES frames; nor
when their exposures are older than twice as much."""
AGE_FRAMES: Final = 5.0

MarkersOf = Callable[[str, str], NDArray[np.float64] | None]
"""Returns the markers of a device's tool in its own coordinates [mm]; None: they are not known."""


GetTipLimits = Callable[[], Mapping[str, Mapping[str, TipLimit]]]
"""Returns the limits of all tools, by device, running or not, and the tool's id."""


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
        markers: MarkersOf = lambda *_: None,
        age_s: float = AGE_S,
        now: Callable[[], float] = time.monotonic,
        wall_ns: Callable[[], int] = time.time_ns,
        tip_limits: GetTipLimits = dict,
    ) -> None:
        self._board = board
        self._chosen = device
        self._markers = markers
        self._age_s = age_s
        self._now = now
        self._wall_ns = wall_ns
        self._tip_limits = tip_limits
        self._came: dict[str, float] = dict.fromkeys(board.newest(), now())
        self._waiting: set[asyncio.Event] = set()
        self._end = board.listen(self._on_poses)

    def look(self, device: str | None) -> PoseView:
        """Return what a session sees: of this device; None: of the one that has tools.

        Tools of a device that does not run are there, without poses.
        """
        newest = self._board.newest()
        device_id = device or self._chosen
        if device_id is None:
            having = [name for name, entry in newest.items() if entry.poses]
            having = having or [name for name, tools in self._tip_limits().items() if tools]
            if len(having) != 1:
                return PoseView(several=len(having) > 1)
            device_id = having[0]
        entry = newest.get(device_id)
        if entry is None:
            tools = tuple(sorted(self._tip_limits().get(device_id, ())))
            return PoseView(device_id, tools=tools, markers=partial(self._markers, device_id))
        fresh = self._fresh(entry)
        return PoseView(
            device_id=device_id,
            tools=tuple(sorted(entry.poses)),
            poses=entry.poses if fresh else {},
            sequence=entry.sequence,
            fresh=fresh,
            frame_rate_hz=entry.frame_rate_hz,
            markers=partial(self._markers, device_id),
            limits=self._tip_limits().get(device_id, {}),
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

    def _on_poses(self, entry: PoseEntry) -> None:
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
