"""Runs the NDI server as long as the application, where settings ask for it."""

import logging
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING

import numpy as np
from fastapi import FastAPI
from numpy.typing import NDArray

from service.allow_list import AllowList
from service.protocols.ndi.metrics_collector import NdiCollector
from service.protocols.ndi.pose_feed import PoseFeed
from service.protocols.ndi.server import NdiOptions, NdiServer
from service.protocols.ndi.tool_cache import ToolCache
from service.settings import Settings
from service.version import package_version

if TYPE_CHECKING:
    from service.pipeline.pipeline_manager import PipelineManager

_log = logging.getLogger(__name__)


@asynccontextmanager
async def ndi_running(app: FastAPI, settings: Settings) -> AsyncIterator[None]:
    """Run it; with no port set, do nothing.

    Args:
        app: with the database, the live side and the metrics in its state; gets ``ndi``.
        settings: of the service.

    Raises:
        OSError: the port is taken, or the address is none of this machine.
    """
    if settings.ndi_port is None:
        yield
        return
    live: PipelineManager = app.state.live
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

    known = ToolCache(app.state.database)
    feed = PoseFeed(live.poses, settings.ndi_device, markers, known=known)
    server = NdiServer(options, feed)
    try:
        await known.start()
        await server.start()
    except OSError as error:
        await known.close()
        _log.critical("NDI clients on %s port %d: %s", options.host, options.port, error)
        raise
    app.state.metrics.add(NdiCollector(server))
    app.state.ndi = server
    try:
        yield
    finally:
        await known.close()
        await server.close()
