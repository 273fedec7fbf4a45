"""What the audit log's entries look like at the edge."""

from typing import Any, Literal

from pydantic import Field

from service.api.base_models import Moment, ResponseModel

Outcome = Literal["done", "refused"]


class Actor(ResponseModel):
    """Who acted."""

    kind: Literal["key", "token", "local", "command", "service"] = Field(
        description="An API key, a token of the identity provider, a program on the server's own "
        "machine without a key, the command line, or the server itself."
    )
    id: str = Field(description="The key's id, the token's subject, or the user.")
    name: str


class AuditEntry(ResponseModel):
    """One change, or an attempt that was refused."""

    id: int
    at: Moment
    actor: Actor
    operation: str = Field(description="The operation's id in the OpenAPI document, or a command.")
    outcome: Outcome
    object_kind: str = Field(description="What was changed: device, calibration, key, ...")
    object_id: str | None
    before: dict[str, Any] | None = Field(description="Values that are no more, in short.")
    after: dict[str, Any] | None = Field(description="Values from then on, in short.")
    detail: str | None = Field(description="Why it was refused.")
    request_id: str | None = Field(description="Also in the answer's header X-Request-ID.")
    address: str | None
