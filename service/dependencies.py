"""What endpoints get handed: database, operation, runs, reports, settings of this application."""

from typing import Annotated

from fastapi import Depends, Request

from service.database.engine import Database
from service.devices.operation import Operation
from service.errors import NotReady
from service.exports.library import Exports
from service.live.manager import LiveManager
from service.recordings.manager import Recordings
from service.reports.kept import KeptReports
from service.runs.manager import RunManager
from service.settings import Settings


def _database(request: Request) -> Database:
    database: Database = request.app.state.database
    return database


def _operation(request: Request) -> Operation:
    operation: Operation = request.app.state.operation
    return operation


def _live(request: Request) -> LiveManager:
    live: LiveManager | None = request.app.state.live
    if live is None:
        raise NotReady("the live pipeline does not run; restart the server", part="live")
    return live


def _runs(request: Request) -> RunManager:
    runs: RunManager = request.app.state.runs
    return runs


def _reports(request: Request) -> KeptReports:
    reports: KeptReports = request.app.state.reports
    return reports


def _recordings(request: Request) -> Recordings:
    recordings: Recordings = request.app.state.recordings
    return recordings


def _exports(request: Request) -> Exports:
    exports: Exports = request.app.state.exports
    return exports


def _settings(request: Request) -> Settings:
    settings: Settings = request.app.state.settings
    return settings


DatabaseDep = Annotated[Database, Depends(_database)]
OperationDep = Annotated[Operation, Depends(_operation)]
LiveDep = Annotated[LiveManager, Depends(_live)]
RunsDep = Annotated[RunManager, Depends(_runs)]
ReportsDep = Annotated[KeptReports, Depends(_reports)]
RecordingsDep = Annotated[Recordings, Depends(_recordings)]
ExportsDep = Annotated[Exports, Depends(_exports)]
SettingsDep = Annotated[Settings, Depends(_settings)]
