"""REST resource /api/v1/log-records: the newest lines of the server's log."""

from datetime import UTC, datetime
from typing import Annotated, Final, Literal

from fastapi import Query
from pydantic import Field

from service.api.base_models import Moment, ResponseModel
from service.api.openapi import ResourceRouter
from service.api.paging import Page, PagingDep, page_of_sequence
from service.logs import RECENT, RecentRecord

router = ResourceRouter("/api/v1/log-records", "server")

Level = Literal["debug", "info", "warning", "error", "critical"]
_LEVELS: Final[tuple[Level, ...]] = ("debug", "info", "warning", "error", "critical")


class LogRecord(ResponseModel):
    """A line of the server's log."""

    id: int = Field(description="Counted from the server's start.")
    created_at: Moment
    level: Level = Field(description="How serious it is.")
    logger: str = Field(description="The part of the server that wrote it.")
    message: str = Field(description="What happened; keys and passwords are hidden.")
    request_id: str | None = Field(description="The request that it belongs to.")
    device_id: str | None = Field(description="The device that it is about.")
    traceback: str | None = Field(description="Of an error.")


@router.operation("GET", "list-log-records", "The newest lines of the server's log")
def list_log_records(
    paging: PagingDep,
    level: Annotated[
        Level, Query(description="This level and those above it.", examples=["warning"])
    ] = "debug",
) -> Page[LogRecord]:
    """Newest first, since the server's start, a thousand at most; its settings say which are
    written.
    """
    least = _LEVELS.index(level)
    found = [one for one in RECENT.newest() if _rank(one.level) >= least]
    return page_of_sequence(found, paging, _document, lambda one: (-one.number,))


def _rank(level: str) -> int:
    return next((rank for rank, name in enumerate(_LEVELS) if name == level), 1)


def _document(record: RecentRecord) -> LogRecord:
    return LogRecord(
        id=record.number,
        created_at=datetime.fromtimestamp(record.created_s, UTC),
        level=_LEVELS[_rank(record.level)],
        logger=record.logger,
        message=record.message,
        request_id=record.request_id,
        device_id=record.device_id,
        traceback=record.traceback,
    )
