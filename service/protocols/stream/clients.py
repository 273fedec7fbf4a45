"""REST resource /api/v1/stream-clients: who receives the streams, and who does not keep up."""

from datetime import UTC, datetime
from typing import Annotated, Literal

from fastapi import Depends, Request
from pydantic import Field

from service.api.base_models import Moment, ResponseModel
from service.api.openapi import ResourceRouter
from service.api.paging import Page, PagingDep, page_of_sequence
from service.protocols.stream.hub import Hub, Subscription

router = ResourceRouter("/api/v1/stream-clients", "server")


class StreamClient(ResponseModel):
    """A client of a device's stream."""

    id: str = Field(description="Of this stream, while it is open.")
    device_id: str = Field(description="The device that it streams.")
    client: str = Field(description="Who opened it: a key, a token's subject, a local program.")
    opened_at: Moment = Field(description="When it was opened.")
    content: list[str] = Field(description="What its frames hold; empty: it gets no frames.")
    encoding: Literal["json", "msgpack"] = Field(description="How its messages are written.")
    mode: Literal["live", "lossless"] = Field(
        description="`live`: a client that falls behind goes on with the newest."
    )
    rate_hz: float | None = Field(description="Largest rate of frames; null: every frame.")
    messages_waiting: int = Field(
        description="Made and not sent yet: few while it keeps up. 0 of one with `rate_hz`."
    )
    messages_missed: int = Field(description="It was too slow for so many, and never gets them.")


def _hub(request: Request) -> Hub:
    hub: Hub = request.app.state.streams
    return hub


@router.operation("GET", "list-stream-clients", "Who receives the streams, and who is slow")
def list_stream_clients(
    hub: Annotated[Hub, Depends(_hub)], paging: PagingDep
) -> Page[StreamClient]:
    """Clients of the websocket, the longest open first."""
    return page_of_sequence(
        hub.subscriptions(), paging, _document, lambda one: (round(one.opened_s * 1e6), _id(one))
    )


def _id(subscription: Subscription) -> str:
    return f"{id(subscription):x}"


def _document(one: Subscription) -> StreamClient:
    request = one.request
    return StreamClient(
        id=_id(one),
        device_id=request.device_id,
        client=one.client,
        opened_at=datetime.fromtimestamp(one.opened_s, UTC),
        content=sorted(request.content),
        encoding=request.encoding,
        mode="lossless" if request.lossless else "live",
        rate_hz=request.rate_hz,
        messages_waiting=one.waiting,
        messages_missed=one.missed,
    )
