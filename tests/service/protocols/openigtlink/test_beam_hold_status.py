"""Beam holds as STATUS: each change at once and in order, all at connection, again and again."""

import asyncio
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from compute.pose.beam_hold import BeamHoldCause
from service.pipeline.beam_hold_registry import BeamHoldRegistry
from service.protocols.openigtlink.beam_hold_status import _CODES, BeamHoldStatusSender
from service.protocols.openigtlink.bodies import StatusCode
from service.protocols.openigtlink.message import Message
from tests.service.api.beam_holds.batches import MS, RULES, WALL_NS, hold, tool_frame
from tests.service.protocols.openigtlink.readers import Status, read_status
from tests.service.protocols.openigtlink.test_application_host import running
from tests.service.protocols.openigtlink.test_client import (
    LOOPS,
    PATIENCE_S,
    Peer,
    run,
    serving,
    until,
)

OK = (1, "OK", "the beam may go on")


class Bench:
    """A board whose clocks stand still between frames: nothing is late by itself."""

    def __init__(self) -> None:
        self.now_ns = 0
        self.board = BeamHoldRegistry(
            lambda *_: None, lambda: self.now_ns * 1e-9, lambda: WALL_NS + self.now_ns
        )

    def show(self, begin_ms: int, until_ms: int, **given: Any) -> None:
        """Show the tool every 10 ms; each frame takes 2 ms until it is here."""
        for time_ms in range(begin_ms, until_ms + 1, 10):
            self.now_ns = (time_ms + 2) * MS
            self.board.take(tool_frame(time_ms * MS, **given))

    def release(self) -> None:
        self.board.set("sim", [hold()])
        self.show(0, 100)


def told(message: Message) -> Status:
    return read_status(message.content)


@pytest.fixture
def unrepeated(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(BeamHoldStatusSender, "repeat", lambda _: None)


async def changes(peer: Peer, count: int, name: str = "watch") -> list[tuple[int, str]]:
    """The next codes and words of a hold that are not those before: repetitions are left out."""
    found: list[tuple[int, str]] = []
    async with asyncio.timeout(PATIENCE_S):
        while len(found) < count:
            status = told(await peer.of("STATUS", name))
            if [(status.code, status.name)] != found[-1:]:
                found.append((status.code, status.name))
    return found


async def other_than(peer: Peer, code: StatusCode, name: str = "watch") -> Message:
    """The next STATUS of a hold that has not a code: holds are told again and again."""
    async with asyncio.timeout(PATIENCE_S):
        while True:
            found = await peer.of("STATUS", name)
            if told(found).code != code:
                return found


@pytest.mark.parametrize("loop", LOOPS)
def test_every_change_is_told_to_everybody_in_order(loop: str):
    async def test() -> None:
        bench = Bench()
        async with serving(holds=bench.board) as served:
            peers = [await served.joined() for _ in range(2)]
            # Not in the loop: frames are taken by another thread.
            await asyncio.to_thread(bench.release)
            for peer in peers:
                assert await changes(peer, 3) == [(16, "NO_DATA"), (13, "SETTLING"), (1, "OK")]
            await asyncio.to_thread(bench.show, 110, 110, shift_mm=1.5)
            for peer in peers:
                status = told(await other_than(peer, StatusCode.OK))
                assert (status.code, status.name) == (8, "MOVED")
                assert "1.50 mm off its reference position" in status.text

    run(test, loop)


@pytest.mark.parametrize(("shift_mm", "silent_ms", "code"), [(1.5, 0, 8), (None, 60, 16)])
def test_that_the_beam_may_go_on_is_not_told_when_it_is_held_again(
    shift_mm: float | None, silent_ms: int, code: int
):
    async def test() -> None:
        bench = Bench()
        async with serving(holds=bench.board) as served:
            peer = await served.joined()
            # All of it before the loop comes to tell of any.
            bench.release()
            if shift_mm is not None:
                bench.show(110, 110, shift_mm=shift_mm)
            bench.now_ns += silent_ms * MS
            codes = [told(await peer.of("STATUS", "watch")).code for _ in range(4)]
            assert StatusCode.OK not in codes
            assert codes[-1] == code

    run(test)


@pytest.mark.usefixtures("unrepeated")
def test_who_connects_is_told_how_all_holds_are():
    async def test() -> None:
        bench = Bench()
        bench.board.set("sim", [hold(), hold(identity="other", referenced=False)])
        bench.show(0, 100)
        async with serving(holds=bench.board) as served:
            peer = await served.connect()
            found = {message.device: message for message in [await peer.message() for _ in "12"]}
            status = told(found["watch"])
            assert (status.code, status.name, status.text) == OK
            assert found["watch"].time_ns > WALL_NS
            status = told(found["other"])
            assert (status.code, status.name) == (16, "NO_DATA")
            assert "reference" in status.text

    run(test)


@pytest.mark.usefixtures("unrepeated")
def test_a_hold_past_its_deadline_is_never_told_to_be_ok():
    """Nobody else looks at the time here: no watchdog, no frame."""

    async def test() -> None:
        bench = Bench()
        bench.release()
        async with serving(holds=bench.board) as served:
            peer = await served.connect()
            assert await changes(peer, 1) == [(1, "OK")]
            bench.now_ns += 60 * MS
            late = await served.connect()
            status = told(await late.message())
            assert (status.code, status.name) == (16, "NO_DATA")
            assert "nothing was measured for" in status.text

    run(test)


def test_silence_is_told_by_repeating_and_when_asked():
    async def test() -> None:
        bench = Bench()
        bench.release()
        async with serving(holds=bench.board) as served:
            peer = await served.connect()
            for _ in range(3):
                assert told(await peer.of("STATUS", "watch")).code == StatusCode.OK
            bench.now_ns += 60 * MS
            await peer.send(Message("GET_STATUS", "watch"), Message("GET_CAPABIL"))
            codes = []
            while (message := await peer.message()).type == "STATUS":
                codes.append(told(message).code)
            # Repeated, perhaps, before it was asked for; held ever since it was.
            assert codes[-1] == 16
            assert sorted(codes) == codes
            await peer.send(Message("GET_STATUS", "nobody"))
            assert told(await peer.of("STATUS", "nobody")).code == StatusCode.NOT_READY

    run(test)


def test_a_latched_hold_says_that_somebody_is_needed():
    async def test() -> None:
        bench = Bench()
        bench.board.set("sim", [hold(rules=replace(RULES, latched=True))])
        bench.show(0, 100)
        bench.show(110, 110, shift_mm=1.5)
        bench.show(120, 300)
        async with serving(holds=bench.board) as served:
            peer = await served.connect()
            assert await changes(peer, 1) == [(14, "LATCHED")]
            bench.board.acknowledge("watch")
            bench.show(310, 320)
            assert told(await other_than(peer, StatusCode.MANUAL_MODE)).code == StatusCode.OK

    run(test)


def test_a_deleted_hold_is_held_to_its_end_and_then_unknown():
    async def test() -> None:
        bench = Bench()
        bench.release()
        async with serving(holds=bench.board) as served:
            peer = await served.connect()
            assert await changes(peer, 1) == [(1, "OK")]
            bench.board.forget("sim")
            status = told(await other_than(peer, StatusCode.OK))
            assert (status.code, status.text) == (16, "the hold was deleted")
            await peer.send(Message("GET_STATUS", "watch"))
            assert told(await peer.of("STATUS", "watch")).code == StatusCode.NOT_READY

    run(test)


def test_long_names_are_cut_and_those_cut_to_the_same_are_never_ok():
    async def test() -> None:
        long, longer = "a-hold-of-twenty-and-more", "a-hold-of-twenty-and-even-more"
        bench = Bench()
        bench.board.set("sim", [hold(identity=long)])
        bench.show(0, 100)
        async with serving(holds=bench.board) as served:
            peer = await served.connect()
            await peer.send(Message("GET_STATUS", long[:20], version=2))
            while (message := await peer.of("STATUS", long[:20])).version < 2:
                assert message.metadata == {}
            assert told(message).code == StatusCode.OK
            assert message.metadata == {"IGTL_DEVICE_NAME": long}
            bench.board.set("sim", [hold(identity=long), hold(identity=longer)])
            status = told(await other_than(peer, StatusCode.OK, long[:20]))
            assert status.code == StatusCode.CONFIGURATION_ERROR
            assert f"{longer}, {long} are cut" in status.text
            bench.show(110, 110)
            codes = {told(await peer.of("STATUS", long[:20])).code for _ in range(4)}
            assert codes == {StatusCode.CONFIGURATION_ERROR}

    run(test)


def test_only_holds_of_the_device_that_a_setting_names():
    async def test() -> None:
        bench = Bench()
        bench.release()
        bench.board.set("mine", [replace(hold(identity="own"), device_id="mine")])
        async with serving(holds=bench.board, device="mine") as served:
            peer = await served.connect()
            assert {(await peer.message()).device for _ in range(3)} == {"own"}

    run(test)


@pytest.mark.usefixtures("unrepeated")
def test_who_does_not_read_is_told_the_newest_when_it_does():
    async def test() -> None:
        bench = Bench()
        bench.release()
        async with serving(holds=bench.board) as served:
            peer = await served.joined()
            assert await changes(peer, 1) == [(1, "OK")]
            (client,) = served.server._clients
            client.pause_writing()
            bench.show(110, 110, shift_mm=1.5)
            bench.show(120, 120)
            await until(lambda: client._misses_holds)
            client.resume_writing()
            # What was said while it did not read, and is not so any more, is left out.
            assert await changes(peer, 1) == [(13, "SETTLING")]

    run(test)


def test_a_board_that_cannot_be_checked_is_never_told_to_be_ok(monkeypatch: pytest.MonkeyPatch):
    async def test() -> None:
        bench = Bench()
        bench.release()
        async with serving(holds=bench.board) as served:
            peer = await served.connect()
            assert await changes(peer, 1) == [(1, "OK")]

            def fails() -> float | None:
                raise RuntimeError("on purpose")

            with monkeypatch.context() as patched:
                patched.setattr(bench.board, "check", fails)
                await peer.send(Message("GET_STATUS", "watch"))
                status = told(await other_than(peer, StatusCode.OK))
                assert (status.code, status.name) == (2, "UNKNOWN")
            # The server has gone on, and tells it again.
            assert await changes(peer, 1) == [(1, "OK")]

    run(test)


def test_every_cause_has_a_code_and_none_of_them_ok():
    assert set(_CODES) == set(BeamHoldCause) - {BeamHoldCause.NONE}
    assert StatusCode.OK not in _CODES.values()


def test_holds_of_the_service_are_told(tmp_path: Path):
    for _, live, wire in running(tmp_path):
        live.holds.set("sim", [hold()])
        status = wire.of("STATUS")
        assert (status.device, told(status).code) == ("watch", 16)
