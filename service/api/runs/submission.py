"""Submission: checks and stores a run in one transaction, then wakes the run manager."""

from collections.abc import Callable
from typing import Annotated, Any, Protocol

from fastapi import Depends, Response
from sqlalchemy.orm import Session

from service.api.dependencies import DatabaseDep, RunsDep, SettingsDep
from service.api.devices.store import get_device
from service.api.runs.schema import Run, run_document
from service.database.models import DeviceRow
from service.jobs import store
from service.jobs.store import Kind


class SubmittedRun(Protocol):
    """What requests of all kinds of runs have."""

    @property
    def id(self) -> str | None:
        """The run's id; None: the server's choice."""

    @property
    def device(self) -> str:
        """The device's id."""


class Submission:
    """Takes the runs of one request."""

    def __init__(
        self, database: DatabaseDep, runs: RunsDep, settings: SettingsDep, response: Response
    ) -> None:
        self._database, self._runs, self._response = database, runs, response
        self._max_waiting = settings.runs_waiting

    def run(
        self,
        kind: Kind,
        request: SubmittedRun,
        stored: Callable[[Session, DeviceRow], dict[str, Any]],
    ) -> Run:
        """Store a run, wake the run manager, and answer with the run's location.

        Args:
            kind: what is computed.
            request: with the ids of the run and the device.
            stored: checks the request, the device being locked, and returns it as it is stored.

        Raises:
            UnknownDevice, RunExists, Busy: as they say, and what ``stored`` raises.
        """
        with self._database.write() as session:
            device = get_device(session, request.device, lock=True)
            row = store.add_run(
                session, kind, device.id, stored(session, device), self._max_waiting, request.id
            )
            made = run_document(row)
        self._runs.submitted()
        self._response.headers["Location"] = f"/api/v1/runs/{made.id}"
        return made


SubmissionDep = Annotated[Submission, Depends()]
