"""Lifespan of the application: parts are opened in order and closed in reverse."""

import socket
from collections.abc import AsyncIterator, Callable
from contextlib import AsyncExitStack, asynccontextmanager
from datetime import UTC, datetime, timedelta
from functools import partial

from anyio.to_thread import run_sync
from fastapi import FastAPI

from service.api.beam_holds.monitor_config import tracking_config_of
from service.api.correction_tables.store import active_calibration
from service.api.devices.device_service import DeviceService, StoredContent
from service.api.devices.profiles import find_profile
from service.api.exports.repository import ExportRepository
from service.api.idempotency import forget_unfinished
from service.api.quality.drift_monitor import DriftMonitor
from service.api.radiometric_calibrations.store import active_radiometric
from service.api.recordings.recording_manager import RecordingManager
from service.api.recordings.retention import RecordingRetention, RetentionLimits
from service.api.runs.kind_registry import kinds_with
from service.api.wave_captures.wave_capture_manager import WaveCaptureManager
from service.api.webhooks.dispatcher import WebhookDispatcher
from service.api.webhooks.sources import EventSources
from service.application.bootstrap import prepare
from service.application.gateway_duties import GatewayDuties
from service.database.engine import Database
from service.database.gateway import DEVICES, Gateway, SharedGateway, directory_identity
from service.database.server_lock import is_unused, server_lock
from service.database.stored_files import StoredFiles
from service.jobs.run_manager import RunManager
from service.jobs.store import running_runs
from service.pipeline.detection_stage import FindProfile
from service.pipeline.interface import Pipeline
from service.pipeline.pipeline_manager import PipelineManager
from service.protocols.metrics.care_collector import CareCollector
from service.protocols.metrics.collectors import (
    DatabaseCollector,
    LiveCollector,
    RecordingsCollector,
    WebhooksCollector,
)
from service.protocols.ndi.lifespan import ndi_running
from service.protocols.openigtlink.application_host import openigtlink_running
from service.protocols.stream.hub import Hub
from service.security.authenticator import Authenticator
from service.settings import Settings
from service.station.remote_pipeline import RemotePipeline
from service.station.station_starter import StationStarter


@asynccontextmanager
async def running(
    app: FastAPI,
    settings: Settings,
    live: Pipeline | None = None,
    started: Callable[[], None] | None = None,
    starter: StationStarter | None = None,
) -> AsyncIterator[None]:
    """Run all parts of the service, which endpoints find in ``app.state``.

    Args:
        app: the application.
        settings: its settings.
        live: takes the live pipeline's place, closed at the end all the same.
        started: called once all is running and before requests are served.
        starter: starts the station; None: one that is made here. Closed at the end all the same.
    """
    async with AsyncExitStack() as stack:

        def at_the_end(close: Callable[[], None]) -> None:
            stack.push_async_callback(run_sync, close)

        at_the_end(app.state.bodies.close)
        at_the_end(app.state.recalculation.close)
        at_the_end(app.state.target_extraction.close)
        starter = StationStarter() if starter is None else starter
        at_the_end(starter.close)
        if live is None and settings.station == "process":
            # It has loaded what a station needs when the database is ready.
            starter.launch()
        database = Database(settings.effective_database_url, query_timeout=True)
        at_the_end(database.close)
        started_at = datetime.now(UTC)
        alone = await run_sync(is_unused, settings.effective_database_url)
        stack.enter_context(server_lock(database))
        named = await run_sync(prepare, settings, database)
        if alone:
            await run_sync(forget_unfinished, database, started_at)
        app.state.database = database
        gateway = await run_sync(_gateway, settings, database)
        app.state.gateway = gateway
        leases = [gateway.files_lease, *([DEVICES] if settings.gateway_devices else [])]
        await run_sync(gateway.join, leases)
        at_the_end(gateway.leave)
        app.state.authenticator = Authenticator(database, settings)
        manager = _live_manager(settings, starter) if live is None else live
        far = None
        if live is None and settings.bus_url is not None:
            # Only here: without a bus its libraries are not loaded.
            from service.application.far_stations import StoredDevices, bus_options
            from service.station.network.pipeline_router import PipelineRouter

            stored_devices = StoredDevices(database)
            hub = manager.streams
            assert isinstance(hub, Hub)
            manager = far = PipelineRouter(
                manager, hub, bus_options(settings), stored_devices.reader
            )
        at_the_end(manager.close)
        app.state.live = manager
        app.state.stations = far
        app.state.streams = manager.streams
        stack.callback(setattr, app.state, "live", None)
        app.state.device_service = DeviceService(
            database,
            manager,
            settings.folders,
            StoredContent(active_calibration, active_radiometric, tracking_config_of),
            gateway,
            own="" if settings.station == "none" else None,
            stations=far,
        )
        if far is not None:
            stored_devices.service = app.state.device_service
            await run_sync(app.state.device_service.assign_stations)
        app.state.wave_captures = WaveCaptureManager(database, manager)
        at_the_end(app.state.wave_captures.close)
        recordings = RecordingManager(
            manager,
            settings.folders.recordings,
            settings.recording_free_bytes,
            settings.recording_flush_s,
            StoredFiles(database, gateway, "recording"),
        )
        at_the_end(recordings.close)
        app.state.recordings = recordings
        retention = RecordingRetention(
            recordings,
            database,
            _retention_limits(settings),
            is_mine=partial(gateway.holds, gateway.files_lease),
        )
        at_the_end(retention.close)
        app.state.retention = retention
        exports = ExportRepository(
            settings.folders.exports,
            settings.recording_free_bytes,
            StoredFiles(database, gateway, "export"),
        )
        app.state.exports = exports
        announce = (recordings.announce_files, exports.announce_files)
        duties = GatewayDuties(gateway, app.state.device_service, named, announce, retention.wake)
        at_the_end(duties.close)
        await run_sync(duties.start)
        kinds = kinds_with(exports, settings.folders.recordings, _profile_finder(settings))
        runs = RunManager(database, settings.runs_at_once, kinds, gateway)
        at_the_end(runs.close)
        app.state.runs = runs
        await run_sync(runs.start)
        gateway.watch(runs.submitted)
        await run_sync(exports.sweep, partial(running_runs, database))
        watch = DriftMonitor(database, manager, is_mine=gateway.watches)
        at_the_end(watch.close)
        watch.start()
        retention.start()
        webhooks = WebhookDispatcher(database)
        at_the_end(webhooks.close)
        webhooks.start()
        app.state.webhooks = webhooks
        sources = EventSources(manager, webhooks.emit, is_mine=gateway.watches)
        at_the_end(sources.close)
        app.state.metrics.add(
            LiveCollector(manager, app.state.streams),
            DatabaseCollector(database, runs.durations),
            RecordingsCollector(recordings, retention),
            CareCollector(
                database,
                settings.data_dir,
                partial(getattr, app.state.authenticator, "failed_logins"),
            ),
            WebhooksCollector(webhooks),
        )
        await stack.enter_async_context(openigtlink_running(app, settings, recordings))
        await stack.enter_async_context(ndi_running(app, settings))
        if started is not None:
            started()
        yield


def _gateway(settings: Settings, database: Database) -> Gateway:
    """Return this server among those on its database; on SQLite it is the only one."""
    if database.engine.dialect.name != "postgresql":
        return Gateway()
    name = f"{socket.gethostname()}:{settings.port}"
    return SharedGateway(database, directory_identity(settings.data_dir), name)


def _retention_limits(settings: Settings) -> RetentionLimits:
    days = settings.recording_max_age_days
    return RetentionLimits(
        None if days is None else timedelta(days=days), settings.recording_max_total_bytes
    )


def _profile_finder(settings: Settings) -> FindProfile:
    return partial(find_profile, profiles_dir=settings.folders.profiles)


def _live_manager(settings: Settings, starter: StationStarter) -> Pipeline:
    find_own_profile = _profile_finder(settings)
    hub = Hub(settings.stream_kept_messages, settings.stream_lag_s)
    if settings.station == "process":
        return RemotePipeline(
            hub,
            starter,
            settings.compute_device,
            find_own_profile,
            settings.station_priority,
            settings.station_cores,
        )
    return PipelineManager(hub, settings.compute_device, find_own_profile)
