"""Runs the OpenIGTLink server as long as the application, where settings ask for it."""

import logging
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from fastapi import FastAPI

from service.api.recordings.recording_manager import RecordingManager
from service.protocols.openigtlink.application_host import ApplicationHost
from service.protocols.openigtlink.metrics_collector import OpenIGTLinkCollector
from service.protocols.openigtlink.server import OpenIGTLinkServer
from service.protocols.openigtlink.settings import server_settings
from service.settings import Settings

_log = logging.getLogger(__name__)


@asynccontextmanager
async def openigtlink_running(
    app: FastAPI, settings: Settings, recordings: RecordingManager
) -> AsyncIterator[None]:
    """Run it; with no port set, do nothing.

    Args:
        app: with the database, the live side and the metrics in its state; gets ``openigtlink``.
        settings: of the service.
        recordings: of this server.

    Raises:
        OSError: the port is taken, or the address is none of this machine.
    """
    found = server_settings(settings)
    if found is None:
        yield
        return
    live = app.state.live
    host = ApplicationHost(app.state.database, live, recordings)
    server = OpenIGTLinkServer(live.poses, host, found, live.holds)
    try:
        await server.start()
    except OSError as error:
        _log.critical("OpenIGTLink on %s port %d: %s", found.host, found.port, error)
        raise
    app.state.metrics.add(OpenIGTLinkCollector(server))
    app.state.openigtlink = server
    try:
        yield
    finally:
        await server.close()
        await host.close()
