"""What clients of the stream read: no "not held" that is older than a hold, on no path."""

import asyncio
import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from compute.pose.beam_hold import BeamHoldTiming
from service.pipeline.beam_hold_registry import BeamHoldRegistry
from service.protocols.stream.hub import Hub, StreamRequest, Subscription
from tests.service.api.beam_holds.batches import MS, RULES, WALL_NS, batch, hold, tool_frame

HOLDS = frozenset({"holds"})
WAYS: dict[str, dict[str, Any]] = {
    "paced": {"rate_hz": 1000.0},
    "every": {},
    "lossless": {"lossless": True},
    "bundled": {"bundle_s": 0.001},
}


class Served:
    """A board and a hub, on clocks of their own."""

    def __init__(self, rules: BeamHoldTiming = RULES) -> None:
        self.now_ns = 0
        self.hub = Hub()
        self.board = BeamHoldRegistry(
            self.hub.publish_hold,
            lambda: self.now_ns * 1e-9,
            lambda: WALL_NS + self.now_ns,
        )
        self.board.set("sim", [hold(rules=rules)])

    def show(self, begin_ms: int, until_ms: int, shift_mm: float = 0.0) -> None:
        """Publish a frame every 10 ms, as a session does."""
        for time_ms in range(begin_ms, until_ms + 1, 10):
            self.publish(self.taken(time_ms, shift_mm))

    def taken(self, time_ms: int, shift_mm: float = 0.0) -> Any:
        """Step the board with a frame that is not published yet."""
        self.now_ns = max(self.now_ns, (time_ms + 2) * MS)
        made = tool_frame(time_ms * MS, shift_mm=shift_mm)
        return replace(made, holds=self.board.take(made))

    def publish(self, made: Any) -> None:
        self.hub.publish_batch(made)


async def says(client: Subscription) -> list[tuple[str, bool]]:
    """All that a client reads now of the hold: the kind of message, and whether it is held."""
    found: list[tuple[str, bool]] = []
    while True:
        try:
            async with asyncio.timeout(0.02):
                message = json.loads(await client.next())
        except TimeoutError:
            return found
        for one in message.get("frames", [message]):
            if one["type"] == "frame":
                found += [("frame", state["held"]) for state in one["holds"]]
            elif one["type"] == "hold":
                found.append(("hold", one["held"]))


def begun(served: Served, **way: Any) -> Subscription:
    return served.hub.subscribe(StreamRequest("sim", HOLDS, "json", **way))


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("read_before", [False, True])
def test_what_waited_while_the_beam_was_held_says_so(way: str, read_before: bool) -> None:
    async def run() -> None:
        served = Served()
        client, quick = begun(served, **WAYS[way]), begun(served, **WAYS[way])
        served.show(0, 150)
        if read_before:
            # What is encoded for one client is kept for the others.
            assert (await says(quick))[-1][1] is False
        served.board.fail("sim", "the device is stopped")
        found = await says(client)
        assert ("hold", True) in found
        assert all(held for _, held in found)
        # And once it is released anew, that is told.
        served.show(160, 300)
        assert (await says(client))[-1] == ("frame", False)

    asyncio.run(run())


@pytest.mark.parametrize("way", WAYS)
def test_a_frame_that_is_published_behind_the_hold_does_not_contradict_it(way: str) -> None:
    async def run() -> None:
        served = Served()
        client = begun(served, **WAYS[way])
        served.show(0, 150)
        assert (await says(client))[-1][1] is False
        between = served.taken(160)
        assert between.holds[0][0].held is False
        served.board.set("sim", [hold(shift_mm=0.5)])
        served.publish(between)
        found = await says(client)
        assert ("hold", True) in found
        assert all(held for _, held in found)

    asyncio.run(run())


@pytest.mark.parametrize("way", WAYS)
def test_past_the_deadline_nothing_that_waited_says_on_whoever_watches(way: str) -> None:
    async def run() -> None:
        served = Served()
        client = begun(served, **WAYS[way])
        served.show(0, 150)
        # Nobody checks the board: the watchdog has not come to it yet.
        served.now_ns = 201 * MS
        assert all(held for _, held in await says(client))

    asyncio.run(run())


def test_frames_before_a_movement_in_one_batch_say_that_it_is_held() -> None:
    async def run() -> None:
        served = Served()
        client = begun(served)
        served.show(0, 150)
        assert (await says(client))[-1][1] is False
        shown = [tool_frame(t * MS, shift_mm=s) for t, s in ((160, 0.0), (170, 0.0), (180, 5.0))]
        poses = [one.motion.poses for one in shown if one.motion is not None]
        made = batch([one.frames[0] for one in shown], [np.empty((0, 3))] * 3, poses)
        served.now_ns = 182 * MS
        served.publish(replace(made, holds=served.board.take(made)))
        assert await says(client) == [("hold", True)] + [("frame", True)] * 3

    asyncio.run(run())


def test_who_comes_back_reads_no_release_that_is_over() -> None:
    async def run() -> None:
        served = Served()
        served.show(0, 150)
        served.board.fail("sim", "the device is stopped")
        log = served.hub.log("sim")
        found = await says(begun(served, lossless=True, stream=log.id, after=0))
        assert len(found) > 15
        assert all(held for _, held in found)

    asyncio.run(run())


def test_a_paced_client_gets_no_frame_that_is_older_than_the_change_it_was_told() -> None:
    async def run() -> None:
        served = Served()
        client = begun(served, rate_hz=1000.0)
        served.show(0, 150)
        served.board.fail("sim", "the device is stopped")
        found = [kind for kind, _ in await says(client)]
        assert found
        assert set(found) == {"hold"}

    asyncio.run(run())
