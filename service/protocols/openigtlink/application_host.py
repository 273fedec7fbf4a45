"""The OpenIGTLink server in the application: its host, its start and its end."""

import logging
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager
from functools import partial
from typing import Final, TypeVar

import numpy as np
from anyio import CapacityLimiter
from anyio.to_thread import run_sync
from fastapi import FastAPI
from sqlalchemy import select
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import Session

from compute.errors import LumilineError
from service.api.recordings.recording_manager import RecordingManager
from service.api.recordings.schema import NewRecording
from service.api.tools.provenance import provenance
from service.api.tools.registrations import measured_points
from service.api.tools.rigid_bodies import body_of
from service.api.tools.tip_limit import tip_limit_of
from service.database.audited_session import entry
from service.database.engine import Database
from service.database.models import RegistrationRow, ToolRow
from service.pipeline.interface import Pipeline
from service.pipeline.transform_names import frame_name
from service.principal import Act, Principal, current_act
from service.problems.errors import UnknownRecording
from service.protocols.openigtlink.counters import OpenIGTLinkCollector
from service.protocols.openigtlink.host import Landmark, Outcome, WireTool, server_settings
from service.protocols.openigtlink.server import OpenIGTLinkServer
from service.security.audit_entry import record_repeats
from service.security.refusal_aggregation import RefusalAggregator
from service.settings import Settings

_log = logging.getLogger(__name__)

_T = TypeVar("_T")
_THREADS: Final = 2
"""Of its own, so that no client of OpenIGTLink takes those of requests."""
_MAX_ITEMS: Final = 1000
_CLIENT: Final = Principal("service", "openigtlink", "OpenIGTLink client", frozenset())


class ApplicationHost:
    """The application as the OpenIGTLink server knows it; used in one event loop."""

    def __init__(self, database: Database, live: Pipeline, recordings: RecordingManager) -> None:
        self._database = database
        self._live = live
        self._recordings = recordings
        self._limiter = CapacityLimiter(_THREADS)
        self._refusals = RefusalAggregator(partial(record_repeats, database))

    async def tools(self) -> Sequence[WireTool]:
        """Return the tools of all devices; raises NotReady while the database does not answer."""
        return await self._in_thread(self._read_tools)

    async def landmarks(self, device_id: str) -> Sequence[Landmark]:
        """Return the points that registrations of a device were measured at."""
        return await self._in_thread(partial(self._read_landmarks, device_id))

    async def devices(self) -> Sequence[str]:
        """Return the devices that run."""
        statuses = self._live.statuses()
        return sorted(name for name, status in statuses.items() if status.state == "running")

    async def start_recording(self, device_id: str, name: str | None) -> str:
        """Begin to record a device; raises what ``Recordings.start`` raises."""
        request = NewRecording(id=name)
        begun = await self._in_thread(partial(self._recordings.start, device_id, request))
        return begun.id

    async def stop_recording(self, device_id: str) -> str:
        """End the recording of a device; raises UnknownRecording when there is none."""
        return await self._in_thread(partial(self._stop, device_id))

    async def audit(
        self, operation: str, address: str, outcome: Outcome, detail: str | None
    ) -> None:
        """Write an entry; refusals that repeat within a minute are counted, and told of later."""
        act = Act(_CLIENT, operation, None, address)
        if outcome == "refused" and not self._refusals.is_first(act):
            return
        try:
            await self._in_thread(partial(self._write, act, outcome, detail))
        except (LumilineError, SQLAlchemyError):
            _log.exception("audit: %s of %s: %s", operation, address, outcome)

    async def close(self) -> None:
        """Tell of all refusals that were counted."""
        await self._refusals.close()

    async def _in_thread(self, do: Callable[[], _T]) -> _T:
        return await run_sync(do, limiter=self._limiter)

    def _read_tools(self) -> tuple[WireTool, ...]:
        with self._database.read() as session:
            rows = session.scalars(select(ToolRow).order_by(ToolRow.id)).all()
            return tuple(_tool(session, row) for row in rows)

    def _read_landmarks(self, device_id: str) -> tuple[Landmark, ...]:
        query = (
            select(RegistrationRow)
            .where(RegistrationRow.device_id == device_id)
            .order_by(RegistrationRow.created_at.desc())
            .limit(_MAX_ITEMS)
        )
        landmarks: list[Landmark] = []
        with self._database.read() as session:
            for row in session.scalars(query):
                owner, of = frame_name(row.reference_id), provenance(session, row)
                landmarks += (
                    Landmark(f"{row.id} {name}", position, owner, of)
                    for name, position in measured_points(row)
                )
        return tuple(landmarks[:_MAX_ITEMS])

    def _stop(self, device_id: str) -> str:
        recording_id = self._recordings.open_recording(device_id)
        if recording_id is None:
            raise UnknownRecording(f'device "{device_id}" is not being recorded')
        done = self._recordings.stop(recording_id)
        return f"{done.frames_written} frames in {done.id}"

    def _write(self, act: Act, outcome: str, detail: str | None) -> None:
        token = current_act.set(act)
        try:
            with self._database.write() as session:
                session.add(entry("openigtlink", None, outcome, detail=detail))
        finally:
            current_act.reset(token)


def _tool(session: Session, row: ToolRow) -> WireTool:
    body = body_of(row)
    tip = None if body.tip_mm is None else np.array(body.tip_mm)
    limit = tip_limit_of(session, row)
    return WireTool(row.id, row.device_id, row.reference_id, body.markers_mm, tip, limit)


@asynccontextmanager
async def openigtlink_running(
    app: FastAPI, settings: Settings, recordings: RecordingManager
) -> AsyncIterator[None]:
    """Run it; with no port set, do nothing.

    Raises:
        OSError: the port is taken, or the address is none of this machine.
    """
    server_options = server_settings(settings)
    if server_options is None:
        yield
        return
    live = app.state.live
    host = ApplicationHost(app.state.database, live, recordings)
    server = OpenIGTLinkServer(live.poses, host, server_options, live.holds)
    try:
        await server.start()
    except OSError as error:
        _log.critical(
            "OpenIGTLink on %s port %d: %s", server_options.host, server_options.port, error
        )
        raise
    app.state.metrics.add(OpenIGTLinkCollector(server.counters, lambda: server.clients))
    app.state.openigtlink = server
    try:
        yield
    finally:
        await server.close()
        await host.close()
