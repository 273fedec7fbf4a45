"""Endpoint parameters from the application's state: database, pipeline, runs, settings."""

from typing import Annotated

from fastapi import Depends, Request

from service.database.engine import Database
from service.jobs.run_manager import RunManager
from service.pipeline.pipeline_manager import PipelineManager
from service.problems.errors import NotReady
from service.settings import Settings


def _database(request: Request) -> Database:
    database: Database = request.app.state.database
    return database


def _live(request: Request) -> PipelineManager:
    live: PipelineManager | None = request.app.state.live
    if live is None:
        raise NotReady("the live pipeline does not run; restart the server", part="live")
    return live


def _runs(request: Request) -> RunManager:
    runs: RunManager = request.app.state.runs
    return runs


def _settings(request: Request) -> Settings:
    settings: Settings = request.app.state.settings
    return settings


DatabaseDep = Annotated[Database, Depends(_database)]
LiveDep = Annotated[PipelineManager, Depends(_live)]
RunsDep = Annotated[RunManager, Depends(_runs)]
SettingsDep = Annotated[Settings, Depends(_settings)]
