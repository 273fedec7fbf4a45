"""Signatures of webhooks: HMAC-SHA256 over id, time and body (standardwebhooks.com)."""

import base64
import hashlib
import hmac
import secrets
from typing import Final

PREFIX: Final = "whsec_"
_SECRET_BYTES: Final = 32


def make_secret() -> str:
    """Return a new secret: 256 bits from the operating system."""
    return PREFIX + base64.b64encode(secrets.token_bytes(_SECRET_BYTES)).decode()


def signed_headers(secret: str, event_id: str, timestamp_s: int, body: bytes) -> dict[str, str]:
    """Return the headers that a receiver checks a request by.

    Args:
        secret: as ``make_secret`` returns it.
        event_id: the same for all attempts; receivers tell repeated ones by it.
        timestamp_s: of this attempt, Unix time; receivers refuse old ones.
        body: of the request.
    """
    key = base64.b64decode(secret.removeprefix(PREFIX))
    text = f"{event_id}.{timestamp_s}.".encode() + body
    digest = base64.b64encode(hmac.new(key, text, hashlib.sha256).digest()).decode()
    return {
        "webhook-id": event_id,
        "webhook-timestamp": str(timestamp_s),
        "webhook-signature": f"v1,{digest}",
    }
