"""The server: many clients, and those that mean no good."""

import asyncio
import random
from collections.abc import Awaitable, Callable

import pytest

from service.allow_list import AllowList
from service.pipeline.frame_batch import LatestPoses
from service.protocols.ndi import server as client_module
from service.protocols.ndi.server import NdiServer
from tests.service.protocols.ndi.fake_poses import Talker, answering, entry, pose

Play = Callable[[NdiServer, LatestPoses], Awaitable[None]]


def play(scene: Play, **options: object) -> None:
    async def run() -> None:
        board = LatestPoses()
        board.put(entry(pose("probe"), pose("ref")))
        async with answering(board, **options) as server:
            await scene(server, board)

    asyncio.run(run())


async def until(condition: Callable[[], bool]) -> None:
    """Wait until something holds; it does, sooner or later, or the test has failed."""
    async with asyncio.timeout(240.0):
        while not condition():
            await asyncio.sleep(0.002)


async def gone(talker: Talker) -> bool:
    """Whether the server has ended the connection, once it has."""
    try:
        async with asyncio.timeout(240.0):
            return await talker.reader.read() == b""
    except ConnectionError:
        return True


def test_clients_have_states_of_their_own():
    async def scene(server: NdiServer, board: LatestPoses) -> None:
        one, two = await Talker.to(server), await Talker.to(server)
        await one.begin()
        assert await two.ask("TX 0001") == "ERROR10"
        assert (await one.ask("TX 0001")).startswith("0201")
        assert await two.ask("INIT") == "OKAY"
        assert await two.ask("PHF 01") == "OKAY"
        board.put(entry(pose("probe", seed=3), pose("ref"), sequence=8))
        assert (await one.ask("TX 0001")).startswith("0201")
        assert server.clients == 2

    play(scene)


def test_commands_in_one_piece_are_answered_in_order():
    async def scene(server: NdiServer, _: LatestPoses) -> None:
        talker = await Talker.to(server)
        talker.writer.write(b"".join(b"ECHO %05d\r" % number for number in range(2000)))
        replies = [(await talker.reader.readuntil(b"\r"))[:-5] for _ in range(2000)]
        assert replies == [b"%05d" % number for number in range(2000)]

    play(scene)


def test_a_client_that_ends_its_side_gets_its_reply():
    async def scene(server: NdiServer, _: LatestPoses) -> None:
        talker = await Talker.to(server)
        talker.writer.write(b"ECHO hello\r")
        talker.writer.write_eof()
        assert (await talker.reader.read())[:-5] == b"hello"

    play(scene)


def test_who_asks_again_gets_the_same_frame_in_the_end():
    async def scene(server: NdiServer, _: LatestPoses) -> None:
        talker = await Talker.to(server)
        await talker.begin()
        assert await talker.ask("TX 0001") == await talker.ask("TX 0001")

    play(scene)


@pytest.mark.parametrize("seed", range(3))
def test_rubbish_does_not_touch_the_others(seed: int):
    async def scene(server: NdiServer, board: LatestPoses) -> None:
        good = await Talker.to(server)
        await good.begin()
        chance = random.Random(seed)
        rubbish = [
            chance.randbytes(20_000),
            b"\xff" * 100_000,
            b"PVWR:" + b"0" * 50_000,
            b"INIT:0000\r" * 500,
            b"INIT:E3A5\rPHRQ *********1****\r" * 40 + b"TSTART",
            b"\0" * 10_000,
            b"GET / HTTP/1.1\r\nHost: x\r\n\r\n",
            b"TX:",
        ]
        for number, data in enumerate(rubbish):
            bad = await Talker.to(server)
            bad.writer.write(data)
            answers = asyncio.create_task(bad.reader.read())
            await bad.writer.drain()
            if number % 2:
                bad.writer.write_eof()
                answered = await answers
                assert len(answered) < 40_000
            else:
                answers.cancel()
                bad.writer.transport.abort()
            board.put(entry(pose("probe", seed=number), pose("ref"), sequence=100 + number))
            told = await good.ask("TX 0001")
            while f"{100 + number:08X}" not in told:
                told = await good.ask("TX 0001")
            assert told.startswith("0201")

    play(scene)


def test_two_hundred_connections():
    """More than there is room for: who said nothing of sense goes first, who tracks stays."""

    async def scene(server: NdiServer, _: LatestPoses) -> None:
        good = await Talker.to(server)
        await good.begin()
        crowd = [await Talker.to(server) for _ in range(200)]
        await until(lambda: server.counts.connections == 201)
        assert (await good.ask("TX 0001")).startswith("0201")
        await until(lambda: server.clients == 4)
        assert [await gone(one) for one in crowd[:197]] == [True] * 197
        for one in crowd[197:]:
            assert await one.ask("INIT") == "OKAY"
        late = await Talker.to(server)
        assert await gone(late)
        assert server.counts.rejected_connections == 1
        assert (await good.ask("BEEP 1")) == "1"

    play(scene, clients=4)


def test_who_reads_nothing_is_ended(monkeypatch: pytest.MonkeyPatch):
    """Its replies do not pile up, either."""
    monkeypatch.setattr(client_module, "STALLED_S", 0.2)

    async def scene(server: NdiServer, _: LatestPoses) -> None:
        silent = await Talker.to(server)
        silent.reader._transport.pause_reading()  # type: ignore[attr-defined]
        (held,) = [await _connected(server)]
        try:
            for _ in range(20_000):
                silent.writer.write(b"ECHO " + b"x" * 1000 + b"\r")
                await silent.writer.drain()
                assert held._writer.transport.get_write_buffer_size() < 100_000
        except ConnectionError:
            pass
        await until(lambda: not server.clients)

    play(scene)


async def _connected(server: NdiServer) -> client_module.ClientConnection:
    await until(lambda: bool(server._clients))
    return next(iter(server._clients.values()))


def test_only_who_is_allowed():
    async def scene(server: NdiServer, _: LatestPoses) -> None:
        server._options.allowed.permits = lambda host: False  # type: ignore[method-assign]
        talker = await Talker.to(server)
        assert await gone(talker)
        assert server.counts.rejected_connections == 1
        assert server.clients == 0

    play(scene)


@pytest.mark.parametrize(
    ("address", "let_in"),
    [
        ("127.0.0.1", True),
        ("127.8.8.8", True),
        ("::1", True),
        ("::ffff:127.0.0.1", True),
        ("10.0.0.7", True),
        ("::ffff:10.0.0.7", True),
        ("10.0.1.7", False),
        ("fd00::5", True),
        ("fe80::5%eth0", False),
        ("192.168.0.1", False),
        ("localhost", False),
        ("", False),
    ],
)
def test_the_list_of_networks(address: str, let_in: bool):
    assert AllowList(("10.0.0.0/24", "fd00::/16")).permits(address) == let_in


def test_closing_ends_everybody():
    async def scene(server: NdiServer, _: LatestPoses) -> None:
        talkers = [await Talker.to(server) for _ in range(3)]
        await talkers[0].begin()
        await server.close()
        assert all([await gone(one) for one in talkers])
        with pytest.raises(OSError):
            await Talker.to(server)

    play(scene)
