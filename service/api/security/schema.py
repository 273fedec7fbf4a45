"""API keys as clients send and receive them."""

from typing import Annotated

from pydantic import Field

from service.api.base_models import (
    Moment,
    RequestModel,
    RequestMoment,
    ResponseModel,
    Text200,
    from_attributes,
)
from service.database.models import ApiKeyRow
from service.principal import SCOPES, Scope
from service.security.store import KeyState, state_of


class NewApiKey(RequestModel):
    """A key to make."""

    name: Text200 = Field(description="Who or what it is for.")
    scopes: Annotated[tuple[Scope, ...], Field(min_length=1, max_length=len(SCOPES))] = Field(
        description="What it may do; none includes another."
    )
    expires_at: RequestMoment | None = Field(
        default=None, description="Until when it is valid; left out: until it is revoked."
    )


class ApiKey(ResponseModel):
    """A key that was given out, without its secret, which is kept nowhere."""

    id: str = Field(description="The part between `lumi_` and the secret.")
    name: str
    scopes: list[Scope]
    state: KeyState
    created_by: str
    created_at: Moment
    expires_at: Moment | None
    revoked_at: Moment | None
    last_used_at: Moment | None = Field(description="To the hour.")


class CreatedApiKey(ApiKey):
    """A key that was just made."""

    key: str = Field(description="Send it as `Authorization: Bearer ...`. It is shown here only.")


def document(row: ApiKeyRow) -> ApiKey:
    """Return a key as clients see it."""
    return from_attributes(ApiKey, row, state=state_of(row))


def created_document(row: ApiKeyRow, text: str) -> CreatedApiKey:
    """Return a key that was just made, with its text."""
    return from_attributes(CreatedApiKey, row, state=state_of(row), key=text)
