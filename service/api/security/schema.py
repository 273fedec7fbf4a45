"""API keys as clients send and receive them."""

from typing import Annotated

from pydantic import Field

from hardware.field_bounds import FIRST_ERROR_ONLY
from service.api.base_models import (
    Moment,
    RequestModel,
    RequestMoment,
    ResponseModel,
    Text200,
    from_attributes,
)
from service.database.models import ApiKeyRow
from service.principal import SCOPES, Kind, Principal, Scope
from service.security.store import KeyState, state_of


class NewApiKey(RequestModel):
    """A key to make."""

    name: Text200 = Field(description="Who or what it is for.")
    scopes: Annotated[
        tuple[Scope, ...], Field(min_length=1, max_length=len(SCOPES)), FIRST_ERROR_ONLY
    ] = Field(description="What it may do; none includes another.")
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


class RequestPrincipal(ResponseModel):
    """Principal of the request, with its scopes."""

    kind: Kind = Field(
        description="An API key, a token of the identity provider, or a program on the server's "
        "own machine without a key."
    )
    id: str = Field(description="The key's id, or the token's subject.")
    name: str
    scopes: list[Scope] = Field(description="What this one may do; none includes another.")
    expires_at: Moment | None = Field(description="Until when the key or token is valid.")


def principal_document(principal: Principal) -> RequestPrincipal:
    """Return a principal as clients see it, the scopes in their usual order."""
    scopes = [scope for scope in SCOPES if scope in principal.scopes]
    return from_attributes(RequestPrincipal, principal, scopes=scopes)


def document(row: ApiKeyRow) -> ApiKey:
    """Return a key as clients see it."""
    return from_attributes(ApiKey, row, state=state_of(row))


def created_document(row: ApiKeyRow, text: str) -> CreatedApiKey:
    """Return a key that was just made, with its text."""
    return from_attributes(CreatedApiKey, row, state=state_of(row), key=text)
