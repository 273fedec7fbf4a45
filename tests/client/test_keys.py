"""A real server that needs keys: how the client shows one, and what a revoked one ends."""

import asyncio
from collections.abc import Iterator
from pathlib import Path

import pytest

from lumiline.client import AsyncClient, Client, ServerProblem, StreamEnded
from lumiline.client.server import KeyBy
from service.cli.keys import create
from tests.running_server import serving


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("keys")


@pytest.fixture(scope="module")
def guarded(folder: Path) -> Iterator[str]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("LUMILINE_AUTHENTICATION", "required")
        patch.setattr("service.protocols.stream.router.ACCESS_CHECK_INTERVAL_S", 0.05)
        with serving(folder) as url:
            yield url


@pytest.fixture
def key(guarded: str, folder: Path, capsys: pytest.CaptureFixture[str]) -> str:
    """A key of every scope, as `lumiline keys create` makes it."""
    create("client", ["all"], None, folder)
    return capsys.readouterr().out.strip().splitlines()[-1]


@pytest.mark.slow
def test_without_a_key_both_interfaces_refuse(guarded: str) -> None:
    with Client(guarded) as client, pytest.raises(ServerProblem) as caught:
        client.devices()
    assert (caught.value.status, caught.value.code) == (401, "unauthenticated")
    with pytest.raises(ServerProblem, match="unauthenticated"):
        Client(guarded).stream("sim").__enter__()


@pytest.mark.parametrize("by", ["header", "subprotocol"])
def test_a_key_opens_both(guarded: str, key: str, by: KeyBy) -> None:
    with Client(guarded, key, key_by=by) as client:
        assert [one.id for one in client.devices()] == ["sim"]
        with client.stream("sim", ("state",)) as stream:
            assert stream.hello is not None
            assert stream.hello.device_id == "sim"


def test_a_key_opens_both_with_asyncio(guarded: str, key: str) -> None:
    async def run() -> None:
        async with AsyncClient(guarded, key, key_by="subprotocol") as client:
            assert [one.id for one in await client.devices()] == ["sim"]
            async with client.stream("sim", ("state",)) as stream:
                assert stream.hello is not None

    asyncio.run(run())


def test_a_revoked_key_ends_the_stream_and_is_not_tried_again(guarded: str, key: str) -> None:
    with Client(guarded, key) as client, client.stream("sim", ("state",)) as stream:
        next(stream)
        client.revoke_key(key.split("_")[1])
        with pytest.raises(StreamEnded, match="revoked") as caught:
            list(stream)
        assert caught.value.code == 1008
    assert key not in str(caught.value)
