"""REST resource /api/v1/keys."""

from typing import Annotated, Any, Final

from fastapi import Body, Path, Request, Response

from compute.errors import InvalidParameter
from service.api.base_models import SLUG_PATTERN, Page
from service.api.dependencies import DatabaseDep
from service.api.json_body import JsonTypes
from service.api.openapi import ResourceRouter, raises
from service.api.request_parameters import Limit, Offset
from service.api.security.schema import ApiKey, CreatedApiKey, NewApiKey, created_document, document
from service.problems.errors import UnknownKey
from service.security import store

router = ResourceRouter("/api/v1/keys", "keys")

_NEW_KEYS: Final[Any] = {
    "display": {
        "summary": "for a program that shows points",
        "value": {"name": "operating room 2", "scopes": ["read:stream"]},
    },
    "engineer": {
        "summary": "for who calibrates",
        "value": {
            "name": "calibration bench",
            "scopes": ["read:stream", "read:calibration", "write:calibration"],
            "expires_at": "2099-12-31T23:59:59Z",
        },
    },
}

KeyPath = Annotated[
    str,
    Path(
        pattern=SLUG_PATTERN,
        description="The key's id: the part between `lumi_` and the secret.",
        openapi_examples={"one": {"summary": "one that was made", "value": "examplekey00"}},
    ),
]


@router.operation("GET", "list-keys", "List keys")
def list_keys(database: DatabaseDep, limit: Limit = 50, offset: Offset = 0) -> Page[ApiKey]:
    """Keys without their secrets, newest first; also those that are not valid any more."""
    with database.read() as session:
        rows, total = store.list_keys(session, limit, offset)
        items = [document(row) for row in rows]
    return Page(items=items, total=total, limit=limit, offset=offset)


@router.operation("POST", "create-key", "Make a key", status_code=201)
@raises(InvalidParameter)
def create_key(
    request: Annotated[NewApiKey, JsonTypes(), Body(openapi_examples=_NEW_KEYS)],
    database: DatabaseDep,
    response: Response,
) -> CreatedApiKey:
    """Make a key. The answer has its text, which is kept nowhere and never shown again.

    Who may make keys may make them with any scope.
    """
    with database.write() as session:
        row, made = store.add_key(session, request)
        created = created_document(row, made.text)
    response.headers["Location"] = f"/api/v1/keys/{created.id}"
    response.headers["Cache-Control"] = "no-store"
    return created


@router.operation("GET /{key_id}", "get-key", "Read a key")
@raises(UnknownKey)
def get_key(key_id: KeyPath, database: DatabaseDep) -> ApiKey:
    """One key, without its secret."""
    with database.read() as session:
        return document(store.get_key(session, key_id))


@router.operation("POST /{key_id}/revoke", "revoke-key", "Revoke a key")
@raises(UnknownKey)
def revoke_key(request: Request, key_id: KeyPath, database: DatabaseDep) -> ApiKey:
    """Take a key back for good: at once for requests, within seconds for open streams."""
    with database.write() as session:
        revoked = document(store.revoke_key(session, key_id))
    request.app.state.authenticator.remembered.forget(key_id)
    return revoked
