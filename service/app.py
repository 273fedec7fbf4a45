"""The application factory: settings in, a FastAPI application with its lifespan out."""

from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from functools import partial
from typing import Final

from anyio.to_thread import run_sync
from fastapi import FastAPI

from service.body_limit import BodyLimit
from service.calibrations.router import router as calibrations
from service.captures.router import router as captures
from service.correction_tables.router import TABLES_PATH
from service.correction_tables.router import router as correction_tables
from service.cross_origin import CrossOriginGuard
from service.database.engine import Database
from service.devices.operation import Operation
from service.devices.profiles import find_profile
from service.devices.router import router as devices
from service.head import HeadAsGet
from service.line_scans.router import router as line_scans
from service.live.manager import LiveManager
from service.openapi import install_openapi
from service.planning.router import router as device_profiles
from service.problem_handlers import install_problem_handlers, no_such_websocket
from service.reconstructions.router import router as reconstructions
from service.reports.kept import KeptReports
from service.reports.router import router as reports
from service.runs.manager import RunManager
from service.runs.router import router as runs_router
from service.server import router as server
from service.settings import Settings
from service.start import prepare
from service.stream import router as stream
from service.version import package_version

DESCRIPTION: Final = """
Calibrates linear (1D) optical sensors and reconstructs 3D points from their readings.

Lengths are in mm, angles in rad, times in UTC; positions on a sensor in pixels, with the centre
of the first pixel at 0. Errors are problem documents (RFC 9457); `GET /problems` lists their
types. Every example below works as it stands on a new server, which has the simulated device
`sim`, but for those of the correction tables `sim-map` and `sim-map-spare`: post the mapping run
first, with that `result_id`.
"""


def create_app(
    settings: Settings,
    live: LiveManager | None = None,
    started: Callable[[], None] | None = None,
) -> FastAPI:
    """Return the application; nothing is opened or started before its lifespan begins.

    Args:
        settings: the settings.
        live: takes the live pipeline's place, closed with the application all the same.
        started: called once all is running and before requests are served.
    """

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        database = Database(settings.effective_database_url)
        try:
            named = await run_sync(prepare, settings, database)
            manager = live
            if manager is None:
                own = partial(find_profile, profiles_dir=settings.folders.profiles)
                manager = LiveManager(settings.compute_device, own)
            try:
                operation = Operation(database, manager, settings.folders)
                app.state.database, app.state.live = database, manager
                app.state.operation = operation
                await run_sync(operation.autostart, *named)
                runs = RunManager(database, settings.runs_at_once)
                app.state.runs = runs
                try:
                    await run_sync(runs.start)
                    if started is not None:
                        started()
                    yield
                finally:
                    await run_sync(runs.close)
            finally:
                app.state.live = None
                await run_sync(manager.close)
        finally:
            await run_sync(database.close)

    app = FastAPI(
        title="Lumiline",
        version=package_version(),
        summary="Tracking server for linear optical sensors",
        description=DESCRIPTION,
        lifespan=lifespan,
        redirect_slashes=False,
    )
    app.state.settings = settings
    app.state.reports = KeptReports()
    app.add_middleware(
        BodyLimit,
        limit_bytes=settings.body_limit_bytes,
        others={TABLES_PATH: settings.table_limit_bytes},
    )
    app.add_middleware(HeadAsGet)
    app.add_middleware(CrossOriginGuard)
    install_problem_handlers(app)
    for router in (
        devices,
        calibrations,
        reports,
        runs_router,
        captures,
        correction_tables,
        reconstructions,
        line_scans,
        device_profiles,
        stream,
        server,
    ):
        app.include_router(router)
    app.add_api_websocket_route("/{path:path}", no_such_websocket)  # the last to be tried
    install_openapi(app)
    return app
