"""NetworkPipeline: what a gateway makes of messages that are missing, late, or of another time."""

import asyncio
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Final, cast

import numpy as np
import pytest

from compute.pose.beam_hold import BeamHoldCause
from compute.reconstruction.point_batch import PointBatch
from compute.signal.peaks import PeakBatch
from hardware.line_frame import LineFrame
from service.pipeline.active_calibration import ActiveCalibration
from service.pipeline.device_status import DeviceStatus
from service.pipeline.frame_batch import BeamEnableToken, BeamHoldState, FrameBatch, LatestPoses
from service.pipeline.tracking_config import NO_TRACKING
from service.protocols.stream.hub import Hub
from service.station.bus_messages import (
    DeviceFigures,
    StationFigures,
    batch_message,
    figures_message,
    hold_message,
    prepared_message,
    presence_message,
    state_message,
)
from service.station.network import network_pipeline
from service.station.network.envelope import Envelope, pack
from service.station.network.messages import Presence, Reply, pack_presence, pack_reply
from service.station.network.network_pipeline import NetworkPipeline, StoredReader
from tests.service.station.network.conftest import eventually
from tests.service.station.test_bus_messages import DESCRIPTION, NAMES

AHEAD_S: Final = 1000.0
"""By how much the station's clock is ahead of this one."""


class Bench:
    """A gateway's side of a station that is played by hand."""

    def __init__(self) -> None:
        self.connected = True
        self.reason = "the bus at nowhere is not reached: it was cut"
        self.asked: list[str] = []
        self.incarnation = "one"
        self.numbers: dict[tuple[str, str | None], int] = {}
        self.reading = asyncio.Event()
        self.reading.set()
        self.loop = asyncio.get_running_loop()
        self.read: list[Any] = []
        self.hub = Hub()
        self.pipeline = NetworkPipeline(
            "bar-1", "gateway-1", self.hub, LatestPoses(), cast("Any", self),
            StoredReader(lambda _: (ActiveCalibration("nominal"), NO_TRACKING), self.calibration),
        )  # fmt: skip

    async def request(self, subject: str, _data: bytes, _timeout_s: float) -> bytes:
        """Answer as a station does, at once."""
        self.asked.append(subject.rpartition(".")[2])
        station_s = time.monotonic() + AHEAD_S
        return pack_reply(Reply(None, None, self.incarnation, {}, station_s))

    async def subscribe(self, *_: Any) -> None:
        """Subscribe to nothing."""

    async def unsubscribe(self, *_: Any) -> None:
        """End nothing."""

    def calibration(self, ids: Any) -> ActiveCalibration:
        """Read a calibration, once that is allowed; called in a thread."""
        asyncio.run_coroutine_threadsafe(self.reading.wait(), self.loop).result()
        self.read.append(ids)
        return ActiveCalibration(ids[0])

    def say(self, kind: str, device: str | None, *messages: bytes, lost: bool = False) -> None:
        """Send messages; ``lost``: they are numbered, and do not come."""
        number = self.numbers.get((kind, device), 0)
        self.numbers[kind, device] = number + 1
        (packed,) = pack(Envelope(self.incarnation, number, 0.0, messages), 1 << 20)
        if not lost:
            self.pipeline.take(kind, device, packed)

    def presence(self, **members: Any) -> bytes:
        """What the station says of itself now."""
        positions = {
            ".".join(filter(None, words)): number - 1 for words, number in self.numbers.items()
        }
        return presence_message(
            pack_presence(Presence("hall", 7, 0, 0, 1, positions=positions, **members))
        )

    def figures(self, state: str = "running", generation: int = 1) -> bytes:
        status = DeviceStatus(cast("Any", state))
        running = state == "running"
        one = DeviceFigures(status, generation, DESCRIPTION, running, running)
        return figures_message(StationFigures({"bar": one}))

    def states(self) -> list[tuple[str, str | None]]:
        """The states that clients of the device were told."""
        return [
            (message["state"], message["reason"])
            for entry in self.hub.log("bar").since(0, 1 << 20)
            for message in entry.messages(frozenset(), 0, entry.count)
            if message["type"] == "state"
        ]


def on_bench(play: Callable[[Bench], Any]) -> None:
    """Play with a bench in an event loop."""

    async def run() -> None:
        bench = Bench()
        try:
            await play(bench)
        finally:
            await bench.pipeline.end()

    asyncio.run(run())


def frame(number: int, calibration: str | None = "nominal") -> bytes:
    """A frame in which nothing was seen."""
    shown = LineFrame("bar", number, number, number, None, np.zeros((4, 0), np.uint16))
    return batch_message(
        FrameBatch(
            "bar", NAMES, calibration, None, (shown,), PeakBatch.empty(4, 1),
            PointBatch.empty(4), np.zeros(0, np.intp), None, (), None,
        ),
        pixels=False,
    )  # fmt: skip


class KeepingTap:
    """Keeps what it is given."""

    wants_pixels: Final = False

    def __init__(self) -> None:
        self.events: list[str | int | None] = []

    def prepare(self, found: ActiveCalibration) -> None:
        self.events.append(found.calibration_id)

    def offer(self, batch: FrameBatch) -> None:
        self.events += [one.sequence for one in batch.frames]


def prepared(calibration: str, tap: int = 1, gateway: str = "gateway-1") -> bytes:
    return prepared_message("bar", gateway, tap, (calibration, None, None), ())


def test_missing_messages_are_counted_and_everything_is_asked_for_again() -> None:
    async def play(bench: Bench) -> None:
        bench.say("state", None, bench.figures())
        await eventually(lambda: "resynchronise" in bench.asked)  # it was not there before
        bench.asked.clear()
        bench.say("state", None, bench.figures(), lost=True)
        bench.say("state", None, bench.figures())
        await eventually(lambda: "resynchronise" in bench.asked)
        assert bench.pipeline.standing.messages_missed == 1

    on_bench(play)


def test_last_message_that_is_missing_is_noticed_without_another() -> None:
    async def play(bench: Bench) -> None:
        held = BeamHoldState("patient", True, BeamHoldCause.NO_DATA, "nothing", 5, revision=1)
        bench.say("holds", None, hold_message("bar", held, last=False))
        bench.say("state", None, bench.presence())
        await eventually(lambda: "resynchronise" in bench.asked)
        bench.asked.clear()
        bench.say("holds", None, hold_message("bar", held, last=False), lost=True)
        bench.say("state", None, bench.presence())
        bench.say("state", None, bench.presence())
        await eventually(lambda: "resynchronise" in bench.asked)
        assert bench.pipeline.standing.messages_missed == 1

    on_bench(play)


def test_messages_of_a_process_that_is_over_are_nobodys() -> None:
    async def play(bench: Bench) -> None:
        bench.say("state", None, bench.figures(), state_message("bar", "running", None))
        assert bench.pipeline.status("bar").state == "running"
        bench.incarnation, before = "two", dict(bench.numbers)
        bench.numbers.clear()
        bench.say("state", None, bench.figures("stopped", 0))
        assert [state for state, _ in bench.states()] == ["running", "disconnected"]
        assert "started again" in (bench.states()[-1][1] or "")
        assert bench.pipeline.status("bar").state == "stopped"
        bench.incarnation, bench.numbers = "one", before
        bench.say("state", None, bench.figures())
        assert bench.pipeline.status("bar").state == "stopped"

    on_bench(play)


def test_station_that_says_nothing_is_lost_and_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(network_pipeline, "LOST_S", 0.2)
    monkeypatch.setattr(network_pipeline, "ASK_S", 0.05)

    async def play(bench: Bench) -> None:
        bench.say("state", None, bench.figures(), state_message("bar", "running", None))
        await eventually(lambda: not bench.pipeline.reached)
        now = bench.pipeline.status("bar")
        assert now.state == "disconnected"
        assert '"bar-1" is lost: the station has said nothing' in (now.reason or "")
        assert bench.pipeline.standing.state == "lost"
        bench.say("state", None, bench.figures(), state_message("bar", "running", None))
        assert bench.pipeline.reached
        assert bench.pipeline.status("bar").state == "running"
        states = [state for state, _ in bench.states()]
        assert states[:3] == ["running", "disconnected", "running"]

    on_bench(play)


def test_station_that_ends_is_lost_at_once_and_found_by_no_word_of_before() -> None:
    async def play(bench: Bench) -> None:
        bench.say("state", None, bench.figures())
        bench.say("state", None, bench.presence(ending=True))
        assert not bench.pipeline.reached
        bench.say("batch", "bar", frame(1))
        assert not bench.pipeline.reached

    on_bench(play)


def enabled(due_here_s: float, revision: int = 1) -> bytes:
    """The beam may go on until a time of this machine's clock, by the station's own."""
    token = BeamEnableToken(time.monotonic)
    token.due_s = due_here_s + AHEAD_S
    now = BeamHoldState(
        "patient", False, BeamHoldCause.NONE, None, 5, release=token, revision=revision
    )
    return hold_message("bar", now, last=False)


def test_beam_is_enabled_no_longer_than_the_station_said_by_its_own_clock() -> None:
    async def play(bench: Bench) -> None:
        def held() -> bool:
            now = bench.pipeline.holds.now("patient")
            assert now is not None
            return now.held

        # Nobody knows yet what its clock says.
        bench.say("holds", None, enabled(time.monotonic() + 60.0))
        assert held()
        await eventually(lambda: "hello" in bench.asked)
        await asyncio.sleep(0.05)
        bench.say("holds", None, enabled(time.monotonic() + 60.0))
        assert not held()
        # One that was in the network for too long enables nothing.
        now = BeamHoldState("patient", True, BeamHoldCause.NO_DATA, "gone", 6, revision=2)
        bench.say("holds", None, hold_message("bar", now, last=False))
        bench.say("holds", None, enabled(time.monotonic() - 0.001, revision=3))
        assert held()
        bench.say("holds", None, enabled(time.monotonic() + 0.2, revision=3))
        assert not held()
        bench.connected = False
        bench.pipeline.bus_changed()
        await eventually(held)
        await eventually(
            lambda: "it was cut" in (bench.pipeline.holds.now("patient") or now).reason
        )

    on_bench(play)


def test_tap_has_each_frame_behind_the_calibration_that_it_was_made_with() -> None:
    async def play(bench: Bench) -> None:
        bench.say("state", None, bench.figures())
        device, tap = bench.pipeline.session("bar"), KeepingTap()
        await asyncio.to_thread(device.attach, tap)
        bench.say("batch", "bar", frame(1))  # before it knows
        bench.reading.clear()
        bench.say("batch", "bar", prepared("first"), frame(2))
        bench.say("batch", "bar", frame(3), prepared("second"), frame(4))
        bench.say("batch", "bar", prepared("third", gateway="gateway-2"), frame(5))
        await asyncio.sleep(0.05)
        assert tap.events == []
        bench.reading.set()
        await eventually(lambda: tap.events and tap.events[-1] == 5)
        assert tap.events == ["first", 2, 3, "second", 4, 5]
        assert bench.read == [("first", None, None), ("second", None, None)]
        # What is known is not read again; what is missing is counted.
        bench.say("batch", "bar", frame(6), lost=True)
        bench.say("batch", "bar", frame(7))
        bench.say("batch", "bar", prepared("second"), frame(8))
        assert tap.events[6:] == ["second", 8]
        assert len(bench.read) == 2
        assert device.frames_dropped == 2

    on_bench(play)


def test_frames_go_to_the_streams_whoever_waits() -> None:
    async def play(bench: Bench) -> None:
        bench.say("state", None, bench.figures())
        for number in range(3):
            bench.say("batch", "bar", frame(number))
        assert bench.hub.log("bar").next == 3

    on_bench(play)


def test_configurations_that_have_changed_are_read_again() -> None:
    async def play(bench: Bench) -> None:
        bench.say("state", None, bench.presence(configurations={"bar": "a"}))
        await eventually(lambda: bench.pipeline.calibration("bar").calibration_id == "nominal")
        bench.pipeline.remember("bar", active=replace(ActiveCalibration(), calibration_id="own"))
        bench.say("state", None, bench.presence(configurations={"bar": "a"}))
        await asyncio.sleep(0.05)
        assert bench.pipeline.calibration("bar").calibration_id == "own"
        bench.say("state", None, bench.presence(configurations={"bar": "b"}))
        await eventually(lambda: bench.pipeline.calibration("bar").calibration_id == "nominal")

    on_bench(play)
