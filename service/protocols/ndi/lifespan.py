"""Runs the NDI server as long as the application, where settings ask for it; its metrics."""

import logging
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Final

import numpy as np
from fastapi import FastAPI
from numpy.typing import NDArray
from prometheus_client import Metric
from prometheus_client.registry import Collector

from service.allow_list import AllowList
from service.protocols.metrics.collectors import Members, members_of, single
from service.protocols.ndi.pose_feed import PoseFeed, ToolCache
from service.protocols.ndi.server import NdiOptions, NdiServer
from service.settings import Settings
from service.version import package_version

if TYPE_CHECKING:
    from service.pipeline.interface import Pipeline

_COUNTS: Final[Members] = (
    ("connections", "Connections of NDI clients that were taken.", "connections"),
    ("connections_refused", "Those that were turned away.", "rejected_connections"),
    ("commands", "Commands of NDI clients that were carried out.", "commands"),
    ("commands_refused", "Those that were refused, and what was none.", "refused"),
)


class NdiCollector(Collector):
    """Metrics of NDI: clients and replies."""

    def __init__(self, server: NdiServer) -> None:
        self._server = server

    def collect(self) -> Iterator[Metric]:
        """Yield what there is."""
        yield single("ndi_clients", "Connected NDI clients.", self._server.clients)
        yield from members_of(_COUNTS, {(): self._server.totals()}, (), "ndi_")


_log = logging.getLogger(__name__)


@asynccontextmanager
async def ndi_running(app: FastAPI, settings: Settings) -> AsyncIterator[None]:
    """Run it; with no port set, do nothing.

    Raises:
        OSError: the port is taken, or the address is none of this machine.
    """
    if settings.ndi_port is None:
        yield
        return
    live: Pipeline = app.state.live
    options = NdiOptions(
        port=settings.ndi_port,
        host=settings.ndi_host,
        allowed=AllowList(settings.ndi_allow),
        clients=settings.ndi_clients,
        model=settings.ndi_model,
        version=package_version(),
        part_numbers=settings.ndi_part_numbers,
    )

    def markers(device_id: str, tool: str) -> NDArray[np.float64] | None:
        tools = live.tracked(device_id).tools
        return next((one.markers_mm for one in tools if one.name == tool), None)

    tool_cache = ToolCache(app.state.database)
    feed = PoseFeed(live.poses, settings.ndi_device, markers, tip_limits=tool_cache)
    server = NdiServer(options, feed)
    try:
        await tool_cache.start()
        await server.start()
    except OSError as error:
        await tool_cache.close()
        _log.critical("NDI clients on %s port %d: %s", options.host, options.port, error)
        raise
    app.state.metrics.add(NdiCollector(server))
    app.state.ndi = server
    try:
        yield
    finally:
        await tool_cache.close()
        await server.close()
