"""REST resource /api/v1/stations: the processes that devices belong to, here and elsewhere."""

from datetime import UTC, datetime
from typing import Final

from pydantic import Field

from service.api.base_models import Moment, ResponseModel
from service.api.inputs import LiveDep
from service.api.openapi import ResourceRouter
from service.api.paging import Page, PagingDep, page_of_sequence
from service.pipeline.interface import StationStanding, StationState

router = ResourceRouter("/api/v1/stations", "stations")

_FIRST: Final = ""


class Station(ResponseModel):
    """A process that devices belong to."""

    name: str | None = Field(description="As devices have it; null: that of this server itself.")
    state: StationStanding = Field(
        description="running; limited: it runs, and something does not work (reason); starting "
        "again; or lost: it does not answer, and its beams are held."
    )
    reason: str | None = Field(description="Why it is not simply running.")
    changed_at: Moment | None = Field(description="Since when it is in this state.")
    host: str | None = Field(description="Its machine; null: this one, or not known yet.")
    devices: int = Field(description="Devices that it has told of.")
    restarts: int = Field(description="How often its process was lost and started again.")
    messages_missed: int = Field(
        description="Messages that were lost on their way to this server, or within the station."
    )
    memory_bytes: int = Field(description="Resident memory of its process [bytes].")
    cpu_s: float = Field(description="Computing time of its process [s].")
    round_trip_ms: float | None = Field(
        description="A question to it over the bus, and its answer [ms]; null: it is not asked."
    )


@router.operation("GET", "list-stations", "Stations and how they stand")
def list_stations(live: LiveDep, paging: PagingDep) -> Page[Station]:
    """This server's own first, where it has one; then those of other machines by name."""
    return page_of_sequence(
        [one.name or _FIRST for one in live.stations],
        paging,
        lambda name: _document({one.name or _FIRST: one for one in live.stations}[name]),
        lambda name: (name,),
    )


def _document(state: StationState) -> Station:
    since = state.since_ns
    return Station(
        name=state.name,
        state=state.state,
        reason=state.reason,
        changed_at=datetime.fromtimestamp(since * 1e-9, UTC) if since else None,
        host=state.host,
        devices=state.devices,
        restarts=state.restarts,
        messages_missed=state.messages_missed,
        memory_bytes=state.memory_bytes,
        cpu_s=state.cpu_s,
        round_trip_ms=None if state.round_trip_s is None else 1e3 * state.round_trip_s,
    )
