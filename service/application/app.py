"""The application factory: settings in, a FastAPI application with its lifespan out."""

from collections.abc import Callable
from functools import cache, partial
from typing import Final

from fastapi import APIRouter, Depends, FastAPI
from starlette.routing import BaseRoute

from service.api.audit.log_records import router as log_records
from service.api.audit.router import router as audit
from service.api.beam_holds.router import router as holds
from service.api.calibrations.nominal_router import router as nominal_calibrations
from service.api.calibrations.router import router as calibrations
from service.api.captures.router import router as captures
from service.api.correction_tables.router import TABLES_PATH
from service.api.correction_tables.router import router as correction_tables
from service.api.devices.profiles import find_profile
from service.api.devices.router import router as devices
from service.api.drift_checks.router import router as drift_checks
from service.api.exports.router import router as exports_router
from service.api.installation.router import router as server_settings
from service.api.json_body import BodyReader
from service.api.line_scans.router import router as line_scans
from service.api.openapi import install_openapi
from service.api.planning.router import router as device_profiles
from service.api.quality.router import router as quality
from service.api.radiometric_calibrations.captures_router import router as radiometric_captures
from service.api.radiometric_calibrations.router import router as radiometric_calibrations
from service.api.reconstructions.router import router as reconstructions
from service.api.recordings.recalculation import Recalculation
from service.api.recordings.router import router as recordings_router
from service.api.recordings.target_extraction import TargetExtraction
from service.api.reports.cache import ReportCache
from service.api.reports.router import router as reports
from service.api.runs.router import router as runs_router
from service.api.security.router import principal_router as principal
from service.api.security.router import router as keys
from service.api.stations.router import router as stations
from service.api.tools.frames_router import router as frames
from service.api.tools.points_router import router as points
from service.api.tools.registrations_router import router as registrations
from service.api.tools.router import router as tools
from service.api.wave_captures.router import router as wave_captures
from service.api.webhooks.router import router as webhooks
from service.application.api_pages import router as api_pages
from service.application.dashboard import router as dashboard
from service.application.lifespan import running
from service.application.middleware import (
    BodyLimitMiddleware,
    CrossOriginMiddleware,
    HeadMiddleware,
    RequestLog,
    SecurityHeadersMiddleware,
)
from service.application.server import router as server
from service.backup.router import router as backups
from service.pipeline.interface import Pipeline
from service.problems.handlers import install_problem_handlers, unknown_websocket
from service.protocols.metrics.registry import Metrics
from service.protocols.metrics.registry import router as metrics
from service.protocols.stream.asyncapi import router as asyncapi
from service.protocols.stream.clients import router as stream_clients
from service.protocols.stream.router import router as stream
from service.security.guard import Guard, check_complete, confirm
from service.security.stream_limit import StreamLimit
from service.settings import Settings
from service.station.station_starter import StationStarter
from service.version import package_version

SMALL_BODY_BYTES: Final = 128 * 1024
"""Largest body of an operation that is in neither list below: parsed in some milliseconds."""
OBSERVATION_BODY_BYTES: Final = 4 * 1024 * 1024
"""Largest body of readings; 10,000 control points of four sensors have 1.7 MB."""
_OBSERVATIONS: Final = (
    *("calibrations", "captures", "reconstructions"),
    *("runs/calibration", "runs/mapping", "runs/self-calibration", "runs/update"),
)
_LARGE: Final = ("line-scans", "line-scans.png", "radiometric-calibrations", "registrations")


def body_limits(settings: Settings) -> dict[str, int]:
    """Return the largest body by path, of the paths that take more than SMALL_BODY_BYTES."""
    largest = settings.body_limit_bytes
    return {
        **{f"/api/v1/{name}": min(OBSERVATION_BODY_BYTES, largest) for name in _OBSERVATIONS},
        **{f"/api/v1/{name}": largest for name in _LARGE},
        TABLES_PATH: settings.table_limit_bytes,
    }


DESCRIPTION: Final = """
Calibrates linear (1D) optical sensors and reconstructs 3D points from their readings.

Lengths are in mm, angles in rad, times in UTC; positions on a sensor in pixels, with the centre
of the first pixel at 0. Errors are problem documents (RFC 9457); `GET /problems` lists their
types. Every example below works as it stands on a new server, which has the simulated device
`sim`, but for those of the correction tables `sim-map` and `sim-map-spare`: post the mapping run
first, with that `result_id`; those of the key `examplekey00`: the server chooses a key's id; and
those of the recording `earlier.h5`: record one of that name; and those that look at a tool or
calibrate one (`tool-captures`, `pivot-calibrations`, `spin-calibrations`), measure with it or by
it (`points`, strobed markers of a registration), or measure a hold's reference: show the device the
tool or the markers first, as docs/how-to/tools.md and docs/how-to/beam-holds.md say.
"""


def create_app(
    settings: Settings,
    live: Pipeline | None = None,
    started: Callable[[], None] | None = None,
    starter: StationStarter | None = None,
) -> FastAPI:
    """Return the application; nothing is opened or started before its lifespan begins.

    Args:
        settings: the settings.
        live: takes the live pipeline's place, closed with the application all the same.
        started: called once all is running and before requests are served.
        starter: starts the station; None: one that is made when the lifespan begins.
    """

    app = FastAPI(
        title="Lumiline",
        version=package_version(),
        summary="Tracking server for linear optical sensors",
        description=DESCRIPTION,
        lifespan=partial(running, settings=settings, live=live, started=started, starter=starter),
        redirect_slashes=False,
        docs_url=None,
        redoc_url=None,
        routes=list(_routes()),
    )
    app.state.settings = settings
    app.state.metrics = Metrics()
    app.state.stopping = False
    app.state.reports = ReportCache()
    app.state.bodies = BodyReader(settings.body_limit_bytes)
    find_own_profile = partial(find_profile, profiles_dir=settings.folders.profiles)
    app.state.recalculation = Recalculation(find_own_profile)
    app.state.target_extraction = TargetExtraction(find_own_profile)
    app.state.open_streams = StreamLimit(settings.streams_per_key)
    app.add_middleware(
        BodyLimitMiddleware,
        limit_bytes=min(SMALL_BODY_BYTES, settings.body_limit_bytes),
        others=body_limits(settings),
        seconds=settings.body_seconds,
    )
    app.add_middleware(Guard, settings=settings)
    app.add_middleware(HeadMiddleware)
    app.add_middleware(CrossOriginMiddleware)
    app.add_middleware(
        RequestLog,
        ended=app.state.metrics.request_ended,
        stopping=partial(getattr, app.state, "stopping"),
    )
    app.add_middleware(SecurityHeadersMiddleware)
    install_problem_handlers(app)
    check_complete(app.routes)
    install_openapi(app)
    return app


@cache
def _routes() -> tuple[BaseRoute, ...]:
    """Return the routes in the order in which they are tried, the same for every application.

    FastAPI takes a quarter of a second to look through all their parameters.
    """
    every = APIRouter(dependencies=[Depends(confirm)])
    for router in (
        devices,
        calibrations,
        nominal_calibrations,
        reports,
        runs_router,
        captures,
        wave_captures,
        radiometric_captures,
        radiometric_calibrations,
        drift_checks,
        correction_tables,
        reconstructions,
        recordings_router,
        exports_router,
        tools,
        points,
        registrations,
        frames,
        holds,
        line_scans,
        device_profiles,
        stream,
        stream_clients,
        asyncapi,
        keys,
        principal,
        webhooks,
        audit,
        log_records,
        server_settings,
        stations,
        backups,
        metrics,
        quality,
        server,
        api_pages,
        dashboard,
    ):
        every.include_router(router)
    every.add_api_websocket_route("/{path:path}", unknown_websocket)  # the last to be tried
    return tuple(every.routes)
