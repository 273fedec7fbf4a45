"""Webhooks as clients send and receive them, and the events that they are sent."""

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, StringConstraints

from hardware.field_bounds import FIRST_ERROR_ONLY
from service.api.base_models import (
    Moment,
    RequestModel,
    ResponseModel,
    Slug,
    Text200,
    absent,
)

EventType = Literal[
    "hold.held", "hold.released", "device.lost", "device.recovered", "drift.detected"
]
DeliveryState = Literal["idle", "delivering", "retrying", "disabled"]

Url = Annotated[str, StringConstraints(min_length=1, max_length=2000)]
"""Which ones are taken: ``target.check_url``."""
EventTypes = Annotated[tuple[EventType, ...], Field(min_length=1, max_length=16), FIRST_ERROR_ONLY]


class NewWebhook(RequestModel):
    """Request of a webhook: its address and its events."""

    id: Slug | None = Field(default=None, description="Left out: the server's choice.")
    title: Text200 = Field(description="Who or what it is for.")
    url: Url = Field(
        description="https://, or http:// to this machine or a private network; link-local and "
        "metadata addresses are refused."
    )
    event_types: EventTypes = Field(description="Only these are sent.")
    enabled: bool = Field(default=True, description="Whether anything is sent.")


class WebhookChange(RequestModel):
    """Changes of a webhook; members left out stay. Another secret needs another webhook."""

    title: Text200 = absent()
    url: Annotated[Url, Field(description="As of a new webhook.")] = absent()
    event_types: Annotated[EventTypes, Field(description="Only these are sent.")] = absent()
    enabled: Annotated[bool, Field(description="Whether anything is sent.")] = absent()


class Webhook(ResponseModel):
    """A webhook, without its secret."""

    id: str
    title: str
    url: str = Field(description="Where events are sent by POST.")
    event_types: list[EventType] = Field(description="Only these are sent.")
    enabled: bool = Field(description="Whether anything is sent.")
    created_at: Moment
    updated_at: Moment


class CreatedWebhook(Webhook):
    """A webhook that was just made."""

    secret: str = Field(
        description="Key of the signatures, `whsec_` and base64. It is shown here only."
    )


class WebhookState(ResponseModel):
    """Deliveries of this server to a webhook, since its start."""

    webhook_id: str = Field(description="The webhook.")
    state: DeliveryState = Field(
        description="`retrying`: the last attempt failed and is repeated. `disabled`: nothing is "
        "sent."
    )
    events_waiting: int = Field(description="Events that wait for their turn.")
    events_delivered: int = Field(description="Answered with 2xx.")
    events_failed: int = Field(description="Given up after the last attempt.")
    events_dropped: int = Field(description="Dropped because too many waited, the oldest first.")
    attempted_at: Moment | None = Field(description="The last attempt; null: none.")
    reason: str | None = Field(description="Why the last attempt failed; null: it did not.")


class Event(BaseModel):
    """An event as it is sent: the body of the request (Standard Webhooks)."""

    model_config = ConfigDict(frozen=True)

    type: str
    timestamp: str
    data: dict[str, Any]
