"""Clients that mean harm, or are broken: the others go on receiving, and nothing grows."""

import asyncio
import random
import struct
from itertools import pairwise

import pytest

from service.protocols.openigtlink.bodies import Command, StatusCode, write_command, write_string
from service.protocols.openigtlink.connection import ClientConnection
from service.protocols.openigtlink.message import Message, write_message
from service.protocols.openigtlink.server import OpenIGTLinkServer
from tests.service.protocols.openigtlink.readers import read_status
from tests.service.protocols.openigtlink.test_client import (
    LOOPS,
    Peer,
    Served,
    entry,
    run,
    serving,
    until,
)
from tests.service.protocols.openigtlink.test_commands import BOMB

both_loops = pytest.mark.parametrize("loop", LOOPS)
CHANCE = random.Random(7)


def clients_of(server: OpenIGTLinkServer) -> set[ClientConnection]:
    found: set[ClientConnection] = server._clients
    return found


def waiting_bytes(server: OpenIGTLinkServer) -> int:
    """What the server holds for clients that do not read, and of what they have sent."""
    return sum(
        client._transport.get_write_buffer_size() + len(client._decoder._buffer)
        for client in clients_of(server)
        if client._transport is not None
    )


async def well_served(served: Served, peer: Peer, number: int) -> None:
    """Whether a good client gets the very next frame."""
    served.put(number)
    while True:
        message = await peer.of("TRANSFORM", "probeToTracker")
        if message.time_ns == entry(number).exposure_ns:
            return


async def told_last(peer: Peer) -> int:
    """The code of the last STATUS before the connection ends."""
    code = 0
    try:
        while True:
            code = read_status((await peer.of("STATUS")).content).code
    except (EOFError, ConnectionError):
        return code


def header(kind: bytes, size: int, version: int = 1) -> bytes:
    return struct.pack(">H12s20sIIQQ", version, kind, b"x", 0, 0, size, 0)


RUBBISH = {
    "random": CHANCE.randbytes(5000),
    "text": b"GET / HTTP/1.1\r\nHost: 127.0.0.1:18944\r\nAccept: */*\r\nX: " + b"y" * 100,
    "zeros": bytes(1000),
    "too-large": header(b"COMMAND", 2**63) + b"x" * 1000,
    "largest": header(b"STT_TDATA", 2**64 - 1),
    "version": header(b"GET_STATUS", 0, 9),
    "type": header(b"\xff\xfe\x00STATUS", 0),
}


@both_loops
@pytest.mark.parametrize("rubbish", RUBBISH.values(), ids=RUBBISH)
def test_what_is_no_openigtlink_ends_its_own_connection_only(rubbish: bytes, loop: str):
    async def test() -> None:
        async with serving() as served:
            good = await served.joined()
            bad = await served.joined()
            await bad.raw(rubbish)
            assert await told_last(bad) in (0, StatusCode.UNKNOWN_INSTRUCTION)
            await until(lambda: served.server.clients == 1)
            assert served.server.counters.ended == {"malformed": 1}
            await well_served(served, good, 1)

    run(test, loop)


def test_a_wrong_checksum_is_told_and_counted_and_the_connection_goes_on():
    async def test() -> None:
        async with serving() as served:
            peer = await served.joined()
            wrong = bytearray(write_message(Message("STT_TDATA", "x", bytes(36))))
            wrong[70] ^= 1
            await peer.raw(bytes(wrong))
            assert read_status((await peer.of("STATUS")).content).code == StatusCode.CHECKSUM_ERROR
            assert served.server.counters.damaged == 1
            assert (await peer.ask(Message("GET_CAPABIL"), "CAPABILITY")).content
            await well_served(served, peer, 1)

    run(test)


def test_contents_that_are_none_are_told():
    async def test() -> None:
        async with serving() as served:
            peer = await served.joined()
            wrong = [
                Message("STT_TDATA", "x", b"12345"),
                Message("COMMAND", "x", b"short"),
                Message("COMMAND", "x", write_command(Command(1, "Version", "x"))[:-1]),
                Message("STRING", "CMD_1", struct.pack(">HH", 9999, 0)),
            ]
            for number, message in enumerate(wrong, 1):
                status = await peer.ask(message, "STATUS")
                assert read_status(status.content).code == StatusCode.UNKNOWN_INSTRUCTION
                assert served.server.counters.damaged == number
            bomb = await peer.ask(Message("STRING", "CMD_2", write_string(BOMB)), "STRING")
            assert b"FAIL" in bomb.content
            await well_served(served, peer, 1)

    run(test)


def test_unknown_types_are_skipped_by_their_length_and_told_once():
    async def test() -> None:
        async with serving() as served:
            peer = await served.joined()
            image = Message("IMAGE", "x", bytes(300_000))
            await peer.send(image, image, image, Message("GET_CAPABIL"))
            status = await peer.message()
            assert read_status(status.content).code == StatusCode.UNKNOWN_INSTRUCTION
            assert (await peer.message()).type == "CAPABILITY"
            assert served.server.counters.received["other"] == 3

    run(test)


def test_half_messages_and_slow_ones_are_ended():
    async def test() -> None:
        async with serving(message_s=0.2) as served:
            good = await served.joined()
            half, slow = await served.joined(), await served.joined()
            whole = write_message(Message("STT_TDATA", "x", bytes(36)))
            await half.raw(whole[:-1])

            async def drip() -> None:
                for at in range(len(whole)):
                    await slow.raw(whole[at : at + 1])
                    await asyncio.sleep(0.05)

            dripping = asyncio.create_task(drip())
            assert await told_last(half) == StatusCode.TIME_OUT
            assert await told_last(slow) in (0, StatusCode.TIME_OUT)
            await until(lambda: served.server.clients == 1)
            assert served.server.counters.ended == {"slow": 2}
            dripping.cancel()
            await asyncio.gather(dripping, return_exceptions=True)
            # One that only listens may do so for as long as it likes.
            await well_served(served, good, 1)

    run(test)


@pytest.mark.slow
@both_loops
def test_a_stalled_client_holds_up_nobody_and_goes_on_with_the_newest(loop: str):
    async def test() -> None:
        async with serving(stall_s=3600.0) as served:
            good = await served.joined()
            stalled = await served.joined()
            await stalled.send(Message("GET_STATUS", version=2))
            stalled.writer.transport.pause_reading()  # type: ignore[attr-defined]
            replaced = served.server.counters
            number, most = 0, 0
            while replaced.frames_replaced < 2000:
                number += 1
                await well_served(served, good, number)
                most = max(most, waiting_bytes(served.server))
                assert number < 200_000
            # One frame more than what a client counts as stalled with.
            assert most < 16 * 1024 + 4 * 1024
            stalled.writer.transport.resume_reading()  # type: ignore[attr-defined]
            seen = [0]
            while seen[-1] != number:
                message = await stalled.of("TRANSFORM", "probeToTracker")
                seen.append(message.time_ns - entry(0).exposure_ns)
            # In order, and short of exactly those that newer ones took the place of.
            steps = [after - before for before, after in pairwise(seen)]
            assert min(steps) > 0
            assert sum(step - 1 for step in steps) == replaced.frames_replaced

    run(test, loop)


@pytest.mark.slow
@both_loops
def test_a_client_that_stays_stalled_is_disconnected(loop: str):
    async def test() -> None:
        async with serving(stall_s=0.1) as served:
            good = await served.joined()
            stalled = await served.joined()
            stalled.writer.transport.pause_reading()  # type: ignore[attr-defined]
            number = 0
            while served.server.clients == 2:
                number += 1
                await well_served(served, good, number)
            assert served.server.counters.ended == {"stalled": 1}

    run(test, loop)


@pytest.mark.slow
@both_loops
def test_a_flood_of_questions_whose_answers_nobody_reads(loop: str):
    async def test() -> None:
        async with serving(stall_s=3600.0) as served:
            good, bad = await served.joined(), await served.joined()
            served.put(0)
            flood = write_message(Message("GET_TRANS")) * 1000
            bad.writer.transport.pause_reading()  # type: ignore[attr-defined]

            async def send() -> None:
                while True:
                    await bad.raw(flood)

            sending = asyncio.create_task(send())
            most = 0
            # Until it is not read from any more, since it does not read its answers.
            for number in range(1, 301):
                await well_served(served, good, number)
                most = max(most, waiting_bytes(served.server))
            assert most < 2 * 2**20
            sending.cancel()
            await asyncio.gather(sending, return_exceptions=True)

    run(test, loop)


@pytest.mark.slow
def test_two_hundred_connections():
    async def test() -> None:
        async with serving(clients=16) as served:
            good = await served.joined()
            rest = await asyncio.gather(*[served.connect() for _ in range(200)])
            for one in rest:
                one.writer.write(b"\xff" * 10)
            number = 0
            counts = served.server.counters
            while counts.refused["full"] < 185:
                number += 1
                await well_served(served, good, number)
            assert served.server.clients == 16
            for one in rest:
                await one.close()
            await until(lambda: served.server.clients == 1)
            await well_served(served, good, number + 1)
            assert counts.refused == {"full": 185}

    run(test)


def test_who_is_in_no_network_that_may_connect_is_told_nothing(monkeypatch: pytest.MonkeyPatch):
    async def test() -> None:
        async with serving(allow=("10.0.0.0/8",)) as served:
            allowed = served.server._allowed
            monkeypatch.setattr(allowed, "permits", lambda address: address == "10.1.2.3")
            peer = await served.connect()
            with pytest.raises((EOFError, ConnectionError)):
                await peer.message()
            assert served.server.counters.refused == {"address": 1}
            assert served.server.clients == 0

    run(test)


def test_a_rate_keeps_the_newest():
    async def test() -> None:
        async with serving() as served:
            served.server.settings.__dict__["rate_hz"] = 4.0
            peer = await served.joined()
            for number in range(100):
                served.put(number)
            seen = []
            while not seen or seen[-1] != 99:
                message = await peer.of("TRANSFORM", "probeToTracker")
                seen.append(message.time_ns - entry(0).exposure_ns)
            # Some at once, for arrivals are never even, and the newest when it was due.
            assert seen[0] == 0
            assert len(seen) < 50
            assert served.server.counters.frames_replaced == 100 - len(seen)

    run(test)
