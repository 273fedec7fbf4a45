"""Fixtures: a pipeline whose devices belong to a station's process."""

import asyncio
import threading
from collections.abc import Callable, Iterator

import pytest

from service.pipeline.detection_stage import built_in_profile
from service.protocols.stream.hub import Hub
from service.station.remote_pipeline import RemotePipeline
from service.station.station_starter import StationStarter
from tests.running_server import shared_starter

WAIT_S = 240.0
"""For what takes a second where the machine has time."""

MakePipeline = Callable[[Hub], RemotePipeline]


@pytest.fixture
def event_loop_thread() -> Iterator[asyncio.AbstractEventLoop]:
    """An event loop that runs in a thread of its own."""
    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=loop.run_forever)
    thread.start()
    yield loop
    loop.call_soon_threadsafe(loop.stop)
    thread.join(WAIT_S)
    loop.close()


@pytest.fixture
def starter() -> StationStarter:
    """Forks stations."""
    return shared_starter()


@pytest.fixture
def make_pipeline(
    event_loop_thread: asyncio.AbstractEventLoop, starter: StationStarter
) -> Iterator[MakePipeline]:
    """Makes pipelines in that loop, which are closed at the end."""
    made: list[RemotePipeline] = []

    async def new(hub: Hub) -> RemotePipeline:
        return RemotePipeline(hub, starter, "cpu", built_in_profile)

    def make(hub: Hub) -> RemotePipeline:
        made.append(asyncio.run_coroutine_threadsafe(new(hub), event_loop_thread).result(WAIT_S))
        return made[-1]

    yield make
    for pipeline in made:
        pipeline.close()


@pytest.fixture
def pipeline(make_pipeline: MakePipeline) -> RemotePipeline:
    """A pipeline with a hub of its own."""
    return make_pipeline(Hub())
