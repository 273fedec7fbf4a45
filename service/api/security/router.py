"""REST resources /api/v1/keys and /api/v1/principal."""

from typing import Annotated, Any, Final

from fastapi import Body, Request, Response

from service.api.inputs import DatabaseDep, JsonTypes, id_in_path
from service.api.openapi import ResourceRouter, raises
from service.api.paging import Page, PagingDep, page_of
from service.api.security.schema import (
    ApiKey,
    CreatedApiKey,
    NewApiKey,
    RequestPrincipal,
    created_document,
    document,
    principal_document,
)
from service.principal import current_act
from service.security import store

router = ResourceRouter("/api/v1/keys", "keys")
principal_router = ResourceRouter("/api/v1/principal", "keys")

_NEW_KEYS: Final[Any] = {
    "display": {
        "summary": "for a program that shows points",
        "value": {"name": "operating room 2", "scopes": ["read:stream"]},
    },
    "therapist": {
        "summary": "for the console of a treatment room",
        "value": {"name": "treatment room 1", "scopes": ["read:stream", "operate:holds"]},
    },
    "engineer": {
        "summary": "for who calibrates",
        "value": {
            "name": "calibration bench",
            "scopes": ["read:stream", "read:calibration", "write:calibrations"],
            "expires_at": "2099-12-31T23:59:59Z",
        },
    },
}

KeyPath = Annotated[
    str,
    id_in_path(
        "The key's id: the part between `lumi_` and the secret.",
        "examplekey00",
        "one",
        "one that was made",
    ),
]


@router.operation("GET", "list-keys", "List keys")
def list_keys(database: DatabaseDep, paging: PagingDep) -> Page[ApiKey]:
    """Keys without their secrets, newest first; also those that are not valid any more."""
    with database.read() as session:
        return page_of(session, store.KEYS.newest_first(), paging, document)


# The answer has the key's text, which is kept nowhere: not to be given again, either.
@router.operation("POST", "create-key", "Make a key", status_code=201, idempotent=False)
@raises("invalid-parameter")
def create_key(
    request: Annotated[NewApiKey, JsonTypes(), Body(openapi_examples=_NEW_KEYS)],
    database: DatabaseDep,
    response: Response,
) -> CreatedApiKey:
    """Make a key. The answer has its text, which is kept nowhere and never shown again.

    Who may make keys may make them with any scope.
    """
    with database.write() as session:
        row, made = store.add_key(session, **dict(request))
        created = created_document(row, made.text)
    response.headers["Location"] = f"/api/v1/keys/{created.id}"
    response.headers["Cache-Control"] = "no-store"
    return created


@router.operation("GET /{key_id}", "get-key", "Read a key")
@raises("unknown-key")
def get_key(key_id: KeyPath, database: DatabaseDep) -> ApiKey:
    """One key, without its secret."""
    with database.read() as session:
        return document(store.KEYS.get(session, key_id))


@router.operation("POST /{key_id}/revoke", "revoke-key", "Revoke a key")
@raises("unknown-key")
def revoke_key(request: Request, key_id: KeyPath, database: DatabaseDep) -> ApiKey:
    """Take a key back for good: at once for requests, within seconds for open streams."""
    with database.write() as session:
        revoked = document(store.revoke_key(session, key_id))
    request.app.state.authenticator.remembered.forget(key_id)
    return revoked


@principal_router.operation("GET", "get-principal", "Who am I, and what may I do?")
def get_principal() -> RequestPrincipal:
    """Whoever makes this request, by its key or token, with its scopes."""
    act = current_act.get()
    if act is None:
        raise RuntimeError("the guard let a request in without an act")
    return principal_document(act.principal)
