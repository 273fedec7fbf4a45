"""What endpoints get handed: database, operation, runs, reports, settings of this application."""

from typing import Annotated

from fastapi import Depends, Request

from service.api.devices.device_service import DeviceService
from service.api.exports.repository import ExportRepository
from service.api.recordings.recording_manager import RecordingManager
from service.api.reports.cache import ReportCache
from service.database.engine import Database
from service.jobs.run_manager import RunManager
from service.pipeline.pipeline_manager import PipelineManager
from service.problems.errors import NotReady
from service.settings import Settings


def _database(request: Request) -> Database:
    database: Database = request.app.state.database
    return database


def _operation(request: Request) -> DeviceService:
    operation: DeviceService = request.app.state.operation
    return operation


def _live(request: Request) -> PipelineManager:
    live: PipelineManager | None = request.app.state.live
    if live is None:
        raise NotReady("the live pipeline does not run; restart the server", part="live")
    return live


def _runs(request: Request) -> RunManager:
    runs: RunManager = request.app.state.runs
    return runs


def _reports(request: Request) -> ReportCache:
    reports: ReportCache = request.app.state.reports
    return reports


def _recordings(request: Request) -> RecordingManager:
    recordings: RecordingManager = request.app.state.recordings
    return recordings


def _exports(request: Request) -> ExportRepository:
    exports: ExportRepository = request.app.state.exports
    return exports


def _settings(request: Request) -> Settings:
    settings: Settings = request.app.state.settings
    return settings


DatabaseDep = Annotated[Database, Depends(_database)]
DeviceServiceDep = Annotated[DeviceService, Depends(_operation)]
LiveDep = Annotated[PipelineManager, Depends(_live)]
RunsDep = Annotated[RunManager, Depends(_runs)]
ReportsDep = Annotated[ReportCache, Depends(_reports)]
RecordingsDep = Annotated[RecordingManager, Depends(_recordings)]
ExportsDep = Annotated[ExportRepository, Depends(_exports)]
SettingsDep = Annotated[Settings, Depends(_settings)]
