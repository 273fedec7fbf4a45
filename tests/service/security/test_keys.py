"""API keys: made, shown once, kept as a digest, used, revoked."""

import string
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from sqlalchemy import text, update

from service.database.models import ApiKeyRow
from service.security import store
from service.security.store import digest, key_id_of, make_key
from tests.service.security.conftest import Secured, bearer, key_id

KEY_CHARACTERS = string.ascii_letters + string.digits


@pytest.fixture
def admin(secured: Secured) -> dict[str, str]:
    return bearer(secured.key("admin:keys", "admin:devices", "read:stream"))


def test_a_made_key_is_shown_once_and_works(secured: Secured, admin: dict[str, str]) -> None:
    body = {"name": "display", "scopes": ["read:stream"]}
    made = secured.client.post("/api/v1/keys", json=body, headers=admin)
    assert made.status_code == 201
    assert made.headers["cache-control"] == "no-store"
    document = made.json()
    assert document["state"] == "valid"
    assert (document["name"], document["scopes"]) == ("display", ["read:stream"])
    key = document.pop("key")
    path = made.headers["location"]
    assert path == f"/api/v1/keys/{key_id(key)}"
    assert secured.ask("GET", "/api/v1/devices", key).status_code == 200
    read = secured.client.get(path, headers=admin)
    assert read.json() == document | {"last_used_at": read.json()["last_used_at"]}
    listed = secured.client.get("/api/v1/keys?limit=200", headers=admin)
    assert document["id"] in [item["id"] for item in listed.json()["items"]]
    for answer in (read, listed):
        assert key.rpartition("_")[2] not in answer.text


def test_the_secret_is_nowhere_in_the_database(secured: Secured, admin: dict[str, str]) -> None:
    body = {"name": "secret", "scopes": ["read:stream"]}
    key = secured.client.post("/api/v1/keys", json=body, headers=admin).json()["key"]
    secured.ask("GET", "/api/v1/devices", key)
    found = ""
    with secured.database.engine.connect() as connection:
        for table in ("api_keys", "audit_log", "activations"):
            rows = connection.execute(text(f"SELECT * FROM {table}")).all()
            found += repr(rows)
    assert key_id(key) in found
    assert digest(key) in found
    assert key.rpartition("_")[2] not in found


@pytest.mark.parametrize("zone", ["-12:00", "+14:00", "Z"])
def test_the_last_moments_that_can_be_given(
    secured: Secured, admin: dict[str, str], zone: str
) -> None:
    body = {"name": "n", "scopes": ["read:stream"], "expires_at": f"9998-12-31T23:59:59{zone}"}
    made = secured.client.post("/api/v1/keys", json=body, headers=admin)
    assert made.status_code == 201
    key = made.json()["key"]
    assert secured.ask("GET", "/api/v1/devices", key).status_code == 200


def test_a_revoked_key_is_refused_at_once(secured: Secured, admin: dict[str, str]) -> None:
    key = secured.key("read:stream")
    assert secured.ask("GET", "/api/v1/devices", key).status_code == 200
    path = f"/api/v1/keys/{key_id(key)}/revoke"
    revoked = secured.client.post(path, headers=admin)
    assert revoked.json()["state"] == "revoked"
    refused = secured.ask("GET", "/api/v1/devices", key)
    assert refused.status_code == 401
    assert "is revoked" in refused.json()["detail"]
    again = secured.client.post(path, headers=admin)
    assert again.json()["revoked_at"] == revoked.json()["revoked_at"]
    assert secured.client.get("/api/v1/keys/nothing", headers=admin).status_code == 404


def test_an_expired_key_is_refused(secured: Secured) -> None:
    refused = secured.ask("GET", "/api/v1/devices", secured.expired("read:stream"))
    assert (refused.status_code, "is expired" in refused.json()["detail"]) == (401, True)


@pytest.mark.parametrize(
    ("change", "status", "part"),
    [
        ({"expires_at": "2020-01-01T00:00:00Z"}, 422, "2020-01-01"),
        ({"expires_at": "2099-01-01T00:00:00"}, 422, "timezone"),
        ({"expires_at": "9999-12-31T23:59:59-12:00"}, 422, "1970 to 9998"),
        ({"expires_at": "1969-12-31T23:59:59Z"}, 422, "1970 to 9998"),
        ({"expires_at": 4070908800}, 422, "expires_at"),
        ({"scopes": []}, 422, "scopes"),
        ({"scopes": ["everything"]}, 422, "everything"),
        ({"name": ""}, 422, "name"),
        ({"digest": "0" * 64}, 422, "digest"),
    ],
)
def test_a_key_that_makes_no_sense(
    secured: Secured, admin: dict[str, str], change: dict[str, Any], status: int, part: str
) -> None:
    body = {"name": "n", "scopes": ["read:stream"]} | change
    answer = secured.client.post("/api/v1/keys", json=body, headers=admin)
    assert answer.status_code == status
    assert part in answer.text


def test_a_key_of_another_secret_is_refused_as_one_that_there_is_not(secured: Secured) -> None:
    key = secured.key("read:stream")
    other = f"lumi_{key_id(key)}_{'x' * 43}"
    unknown = f"lumi_{'0' * 12}_{'x' * 43}"
    answers = [secured.ask("GET", "/api/v1/devices", one) for one in (other, unknown)]
    assert [answer.status_code for answer in answers] == [401, 401]
    # Nothing tells which ids there are.
    assert answers[0].json() == answers[1].json()


def test_last_use_is_written_down_once_in_a_while(secured: Secured) -> None:
    key = secured.key("read:stream")

    def last_used() -> datetime | None:
        with secured.database.read() as session:
            return session.get_one(ApiKeyRow, key_id(key)).last_used_at

    assert last_used() is None
    secured.ask("GET", "/api/v1/devices", key)
    first = last_used()
    assert first is not None
    secured.ask("GET", "/api/v1/devices", key)
    assert last_used() == first
    before = datetime.now(UTC) - store.USED_EVERY - timedelta(seconds=1)
    with secured.database.write() as session:
        query = update(ApiKeyRow).where(ApiKeyRow.id == key_id(key))
        session.execute(query.values(last_used_at=before))
    secured.ask("GET", "/api/v1/devices", key)
    found = last_used()
    assert found is not None
    assert found > before


def test_every_key_is_another_and_has_the_form() -> None:
    made = [make_key() for _ in range(200)]
    assert len({key.id for key in made}) == len({key.text for key in made}) == 200
    for key in made:
        assert key_id_of(key.text) == key.id
        assert key.text not in repr(key)
        assert len(key.digest) == 64


@given(st.text(max_size=80))
def test_text_that_is_no_key_has_no_id(given_text: str) -> None:
    assert key_id_of(given_text) is None
    assert key_id_of(f"lumi_{given_text}") is None or len(given_text) == 56


@given(st.integers(0, 60), st.characters())
def test_a_key_with_a_wrong_character_is_another(place: int, character: str) -> None:
    key = KEY.text
    changed = key[:place] + character + key[place + 1 :]
    found = key_id_of(changed)
    assert changed == key or found != KEY.id or digest(changed) != KEY.digest
    if character not in KEY_CHARACTERS and changed != key:
        assert found is None


KEY = store.make_key()
