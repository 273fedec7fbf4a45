"""Fixtures: a broker, an event loop, and connections in it."""

import asyncio
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.nats_server import NatsServer


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[NatsServer]:
    """A broker of the test's own."""
    server = NatsServer(tmp_path)
    server.start()
    yield server
    server.kill()


async def eventually(condition: object, within_s: float = 60.0) -> None:
    """Wait until a condition is true."""
    end = asyncio.get_running_loop().time() + within_s
    while not condition():  # type: ignore[operator]
        assert asyncio.get_running_loop().time() < end, "it did not happen"
        await asyncio.sleep(0.01)
