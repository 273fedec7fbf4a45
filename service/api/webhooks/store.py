"""Webhooks in the database; the secret is there as it is, since signatures are made with it."""

import secrets
from datetime import UTC, datetime
from typing import Final

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from service.api.base_models import from_attributes
from service.api.webhooks.schema import CreatedWebhook, NewWebhook, Webhook, WebhookChange
from service.api.webhooks.signature import make_secret
from service.api.webhooks.target import TargetRefused, check_url
from service.database.engine import Resource
from service.database.models import WebhookRow
from service.problems.errors import (
    TooManyWebhooks,
    UnknownWebhook,
    WebhookExists,
    WebhookTargetRefused,
)

WEBHOOKS: Final = Resource(WebhookRow, "webhook", UnknownWebhook, WebhookExists)
MAX_WEBHOOKS: Final = 32


def add_webhook(session: Session, request: NewWebhook) -> WebhookRow:
    """Store a webhook with a new secret.

    Raises:
        WebhookExists: the id is taken.
        TooManyWebhooks: there are as many as may be.
        WebhookTargetRefused: no event is sent to such a URL.
    """
    WEBHOOKS.check_unused(session, request.id)
    _check_target(request.url)
    count = session.scalar(select(func.count()).select_from(WebhookRow)) or 0
    if count >= MAX_WEBHOOKS:
        raise TooManyWebhooks(
            f"there are {count} webhooks already, as many as may be; delete one", webhooks=count
        )
    now = datetime.now(UTC)
    members = request.model_dump(mode="json", exclude={"id"})
    row = WebhookRow(
        id=request.id or f"webhook-{secrets.token_hex(8)}",
        secret=make_secret(), created_at=now, updated_at=now, **members,
    )  # fmt: skip
    return WEBHOOKS.insert(session, row)


def change_webhook(row: WebhookRow, request: WebhookChange) -> None:
    """Change what is given; raises WebhookTargetRefused."""
    if "url" in request.model_fields_set:
        _check_target(request.url)
    for name, value in request.model_dump(mode="json", exclude_unset=True).items():
        setattr(row, name, value)
    row.updated_at = datetime.now(UTC)


def _check_target(url: str) -> None:
    try:
        check_url(url)
    except TargetRefused as error:
        # Not the URL itself, which may hold a password.
        raise WebhookTargetRefused(f"the webhook's url: {error}") from None


def document(row: WebhookRow) -> Webhook:
    """Return a webhook as clients see it."""
    return from_attributes(Webhook, row)


def created_document(row: WebhookRow) -> CreatedWebhook:
    """Return a webhook that was just made, with its secret."""
    return from_attributes(CreatedWebhook, row)
