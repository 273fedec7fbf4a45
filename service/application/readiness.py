"""Readiness check: whether requests can be served, and what prevents it."""

import shutil
from collections.abc import Iterator
from typing import Final

from sqlalchemy.exc import SQLAlchemyError

from service.api.recordings.recording_manager import RecordingManager
from service.database.engine import Database
from service.database.migration import newest_revision, revision_of
from service.jobs.run_manager import RunManager
from service.pipeline.pipeline_manager import PipelineManager
from service.problems.errors import NotReady

STUCK_AFTER_S: Final = 30.0
"""A compute thread that is so long at one batch, or at making ready one device, is stuck."""
MIN_FREE_BYTES: Final = 64 * 2**20
"""Without so much room a SQLite database may fail to be written, and nothing works then."""

_Complaint = tuple[str, str]
"""Of which part, and what is wrong with it."""


def check_ready(
    database: Database,
    live: PipelineManager | None,
    runs: RunManager,
    recordings: RecordingManager,
) -> None:
    """Return when requests can be served.

    Raises:
        NotReady: what stands in the way; all of it in the message, the first as ``part``.
    """
    found = [
        *_database(database),
        *_live(live),
        *_runs(runs),
        *_disk(recordings),
    ]
    if found:
        raise NotReady("; ".join(text for _, text in found), part=found[0][0])


def limits(recordings: RecordingManager) -> list[str]:
    """Return what does not work now although requests are served."""
    free = _free(recordings)
    if free is not None and free < recordings.free_bytes:
        return ["recordings: the disk is too full to begin one"]
    return []


def failed_devices(live: PipelineManager) -> list[str]:
    """Return the devices that failed, which keep the others and the server from nothing."""
    return [name for name, status in live.statuses().items() if status.state == "failed"]


def _database(database: Database) -> Iterator[_Complaint]:
    try:
        with database.engine.connect() as connection:
            revision = revision_of(connection)
    except SQLAlchemyError as error:
        # Not the error's text: it may hold the URL with the password.
        kind = type(error).__name__
        text = f"the database does not answer ({kind}); it must accept connections"
        yield "database", text
        return
    newest = newest_revision()
    if revision != newest:
        text = (
            f"the database is of revision {revision}, this version of the service is of {newest}; "
            "restart the server with the version that the database is of"
        )
        yield "database", text


def _live(live: PipelineManager | None) -> Iterator[_Complaint]:
    if live is None or not live.ready:
        yield "live", "the live pipeline does not run; restart the server"
        return
    busy_s = live.busy_s
    if busy_s > STUCK_AFTER_S:
        text = f"the live pipeline is at one step for {busy_s:.0f} s; restart the server"
        yield "live", f"{text} when it stays so"


def _runs(runs: RunManager) -> Iterator[_Complaint]:
    if not runs.alive:
        yield "runs", "no runs are taken any more; restart the server"


def _disk(recordings: RecordingManager) -> Iterator[_Complaint]:
    free = _free(recordings)
    if free is None:
        yield "disk", "the folder of recordings cannot be read; it must be there"
    elif free < MIN_FREE_BYTES:
        text = (
            f"{free} bytes are free on the disk of the data directory, which needs "
            f"{MIN_FREE_BYTES}; delete recordings"
        )
        yield "disk", text


def _free(recordings: RecordingManager) -> int | None:
    try:
        return shutil.disk_usage(recordings.library.folder).free
    except OSError:
        return None
