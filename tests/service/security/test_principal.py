"""GET /api/v1/principal: a client learns who it is for the server."""

from typing import Any

from service.principal import SCOPES


def test_local_program_may_do_everything(sqlite_client: Any):
    found = sqlite_client.get("/api/v1/principal").json()
    assert (found["kind"], found["expires_at"]) == ("local", None)
    assert found["scopes"] == list(SCOPES)


def test_key_has_its_own_scopes_and_expiry(sqlite_client: Any):
    body = {
        "name": "display",
        "scopes": ["operate:holds", "read:stream"],
        "expires_at": "2099-01-01T00:00:00Z",
    }
    key = sqlite_client.post("/api/v1/keys", json=body).json()
    headers = {"Authorization": f"Bearer {key['key']}"}
    found = sqlite_client.get("/api/v1/principal", headers=headers).json()
    assert found == {
        "kind": "key",
        "id": key["id"],
        "name": "display",
        "scopes": ["read:stream", "operate:holds"],
        "expires_at": "2099-01-01T00:00:00Z",
    }
