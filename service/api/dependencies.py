"""Endpoint parameters from the application's state: database, pipeline, runs, settings."""

from typing import Annotated, Any

from fastapi import Depends, Request

from service.database.engine import Database
from service.jobs.run_manager import RunManager
from service.pipeline.pipeline_manager import PipelineManager
from service.problems.errors import NotReady
from service.settings import Settings


def of_application(name: str) -> Any:
    """Return the dependency on a part of the application, by its name in ``app.state``."""

    def part(request: Request) -> Any:
        return getattr(request.app.state, name)

    return Depends(part)


def _live(request: Request) -> PipelineManager:
    live: PipelineManager | None = request.app.state.live
    if live is None:
        raise NotReady("the live pipeline does not run; restart the server", part="live")
    return live


DatabaseDep = Annotated[Database, of_application("database")]
LiveDep = Annotated[PipelineManager, Depends(_live)]
RunsDep = Annotated[RunManager, of_application("runs")]
SettingsDep = Annotated[Settings, of_application("settings")]
