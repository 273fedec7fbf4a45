"""REST resource /api/v1/webhooks."""

from typing import Annotated, Any, Final

from fastapi import Body, Response

from service.api.inputs import DatabaseDep, JsonTypes, id_in_path
from service.api.openapi import ResourceRouter, raises
from service.api.paging import Page, PagingDep, page_of
from service.api.preconditions import OptionalIfMatch, RequiredIfMatch
from service.api.webhooks import store
from service.api.webhooks.dispatcher import WebhooksDep
from service.api.webhooks.schema import (
    CreatedWebhook,
    NewWebhook,
    Webhook,
    WebhookChange,
    WebhookState,
)
from service.problems.errors import UnknownWebhook

router = ResourceRouter("/api/v1/webhooks", "webhooks")

_NEW: Final[Any] = {
    "alarm": {
        "summary": "an alarm when a beam is held or a device is lost",
        "value": {
            "id": "alarm",
            "title": "Alarm of room 2",
            "url": "https://alarm.example.org/lumiline",
            "event_types": ["hold.held", "device.lost", "device.recovered"],
        },
    },
}
_CHANGES: Final[Any] = {
    "off": {"summary": "send nothing for now", "value": {"enabled": False}},
}
WebhookPath = Annotated[str, id_in_path("The webhook's id.", "alarm", "alarm")]


@router.operation("GET", "list-webhooks", "List webhooks")
def list_webhooks(database: DatabaseDep, paging: PagingDep) -> Page[Webhook]:
    """Webhooks without their secrets, newest first."""
    with database.read() as session:
        return page_of(session, store.WEBHOOKS.newest_first(), paging, store.document)


# The answer has the secret, which is not shown again: not to be kept for repeated requests, either.
@router.operation("POST", "create-webhook", "Make a webhook", status_code=201, idempotent=False)
@raises("webhook-exists", "too-many-webhooks", "webhook-target-refused")
def create_webhook(
    request: Annotated[NewWebhook, JsonTypes(), Body(openapi_examples=_NEW)],
    database: DatabaseDep,
    webhooks: WebhooksDep,
    response: Response,
) -> CreatedWebhook:
    """Send events to an address from now on. The answer has the secret, which is shown once."""
    with database.write() as session:
        created = store.created_document(store.add_webhook(session, request))
    webhooks.reload()
    response.headers["Location"] = f"/api/v1/webhooks/{created.id}"
    response.headers["Cache-Control"] = "no-store"
    return created


@router.operation("GET /{webhook_id}", "get-webhook", "Read a webhook")
@raises("unknown-webhook")
def get_webhook(webhook_id: WebhookPath, database: DatabaseDep) -> Webhook:
    """One webhook, without its secret."""
    with database.read() as session:
        return store.document(store.WEBHOOKS.get(session, webhook_id))


@router.operation("GET /{webhook_id}/state", "get-webhook-state", "How deliveries go")
@raises("unknown-webhook")
def get_webhook_state(
    webhook_id: WebhookPath, database: DatabaseDep, webhooks: WebhooksDep
) -> WebhookState:
    """Events that this server has delivered, given up and dropped since its start."""
    with database.read() as session:
        store.WEBHOOKS.get(session, webhook_id)
    found = webhooks.states().get(webhook_id)
    if found is None:
        webhooks.reload()
        found = webhooks.states().get(webhook_id)
    if found is None:  # deleted meanwhile
        raise UnknownWebhook(f'there is no webhook "{webhook_id}"', webhook_id=webhook_id)
    return found


@router.operation("POST /{webhook_id}/test", "test-webhook", "Send a test event", status_code=202)
@raises("unknown-webhook")
def send_test_event(
    webhook_id: WebhookPath, database: DatabaseDep, webhooks: WebhooksDep
) -> WebhookState:
    """Queue an event `webhook.test`; the state says what became of it."""
    with database.read() as session:
        store.WEBHOOKS.get(session, webhook_id)
    webhooks.test(webhook_id)
    return get_webhook_state(webhook_id, database, webhooks)


@router.operation("PATCH /{webhook_id}", "change-webhook", "Change a webhook")
@raises("unknown-webhook", "webhook-target-refused")
@raises("precondition-failed", "precondition-required", "invalid-precondition")
def change_webhook(
    webhook_id: WebhookPath,
    request: Annotated[WebhookChange, JsonTypes(), Body(openapi_examples=_CHANGES)],
    database: DatabaseDep,
    webhooks: WebhooksDep,
    expected: RequiredIfMatch,
) -> Webhook:
    """Change what is given; events that wait go to the new address."""
    with database.write() as session:
        row = store.WEBHOOKS.get(session, webhook_id, lock=True)
        expected.check(store.document(row))
        store.change_webhook(row, request)
        changed = store.document(row)
    webhooks.reload()
    return changed


@router.operation("DELETE /{webhook_id}", "delete-webhook", "Delete a webhook")
@raises("unknown-webhook", "precondition-failed", "invalid-precondition")
def delete_webhook(
    webhook_id: WebhookPath,
    database: DatabaseDep,
    webhooks: WebhooksDep,
    expected: OptionalIfMatch,
) -> None:
    """Send nothing more; events that wait are dropped."""
    with database.write() as session:
        row = store.WEBHOOKS.get(session, webhook_id, lock=True)
        expected.check(store.document(row))
        session.delete(row)
    webhooks.reload()
