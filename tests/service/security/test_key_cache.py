"""Without its database a server knows the keys that were valid shortly before, and no others."""

from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest
from sqlalchemy import update

from service.application.app import create_app
from service.database.models import ApiKeyRow
from service.principal import Principal
from service.security import store
from service.security.authenticator import CACHE_LIFETIME_S, KeyCache
from service.settings import Settings
from tests.service.fake_pipeline import FakePipeline, TestClient
from tests.service.security.conftest import Secured, bearer, key_id
from tests.service.test_outage import unreachable

STOP = "/api/v1/devices/sim/stop"
ADA = Principal("key", "a", "ada", frozenset({"read:stream"}))


def test_only_the_same_text_and_only_for_a_while() -> None:
    now = [0.0]
    keys = KeyCache(lambda: now[0])
    keys.valid("a", "1" * 64, ADA)
    assert keys.principal("a", "1" * 64) == ADA
    assert keys.principal("a", "2" * 64) is None
    assert keys.principal("b", "1" * 64) is None
    now[0] = CACHE_LIFETIME_S - 0.1
    assert keys.principal("a", "1" * 64) == ADA
    now[0] = CACHE_LIFETIME_S
    assert keys.principal("a", "1" * 64) is None
    keys.valid("a", "1" * 64, ADA)
    keys.forget("a")
    assert keys.principal("a", "1" * 64) is None


def test_memory_is_bounded() -> None:
    keys = KeyCache(max_entries=3)
    for number in range(10):
        keys.valid("first", "1", ADA)
        keys.valid(str(number), "1", ADA)
        assert len(keys) <= 3
    assert keys.principal("first", "1") == ADA
    assert keys.principal("0", "1") is None


@pytest.fixture
def server(tmp_path: Any) -> Iterator[Secured]:
    settings = Settings(data_dir=tmp_path, authentication="required")
    with TestClient(create_app(settings, FakePipeline()), raise_server_exceptions=False) as client:
        yield Secured(client)


@pytest.fixture
def lost(server: Secured, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """A call that takes the server's database away."""
    gone = unreachable()

    def lose() -> None:
        monkeypatch.setattr(server.database, "engine", gone.engine)
        monkeypatch.setattr(server.database, "_writer", gone.engine)

    yield lose
    monkeypatch.undo()
    gone.close()


def test_a_device_is_stopped_without_the_database(server: Secured, lost: Any) -> None:
    used = server.key("operate:devices", "read:stream")
    reads, unused = server.key("read:stream"), server.key("operate:devices")
    for key in (used, reads):
        assert server.ask("GET", "/api/v1/devices", key).status_code in (200, 403)
    lost()
    stopped = server.ask("POST", STOP, used)
    assert (stopped.status_code, stopped.json()["state"]) == (200, "stopped")
    assert server.ask("POST", STOP, reads).status_code == 403
    # What was not asked for before is unknown, and a wrong key stays one that nobody vouches for.
    for key in (unused, f"{used[:18]}{'x' * 43}"):
        answer = server.ask("POST", STOP, key)
        assert (answer.status_code, answer.json()["type"]) == (503, "/problems/not-ready")


@pytest.mark.slow
def test_a_key_that_was_taken_back_or_ended_is_not_known(server: Secured, lost: Any) -> None:
    admin = server.key("admin:keys")
    revoked, ended = server.key("operate:devices"), server.key("operate:devices")
    soon = datetime.now(UTC) + timedelta(seconds=30)
    with server.database.write() as session:
        query = update(ApiKeyRow).where(ApiKeyRow.id == key_id(ended))
        session.execute(query.values(expires_at=soon))
    for key in (revoked, ended):  # known, but without the scope to read
        assert server.ask("GET", "/api/v1/devices", key).status_code == 403
    path = f"/api/v1/keys/{key_id(revoked)}/revoke"
    assert server.client.post(path, headers=bearer(admin)).status_code == 200
    remembered = server.client.app.state.authenticator.remembered
    digest, found = remembered._entries[key_id(ended)]
    past = Principal(found.kind, found.id, found.name, found.scopes, datetime.now(UTC))
    remembered._entries[key_id(ended)] = (digest, past)
    lost()
    # The device runs, so that nothing but the key could ask for the database.
    assert server.ask("POST", STOP, revoked).status_code == 503
    answer = server.ask("POST", STOP, ended)
    assert (answer.status_code, "is expired" in answer.json()["detail"]) == (401, True)


def test_a_key_that_another_process_revoked_is_forgotten_when_it_is_seen(server: Secured) -> None:
    key = server.key("read:stream")
    remembered = server.client.app.state.authenticator.remembered
    assert server.ask("GET", "/api/v1/devices", key).status_code == 200
    assert len(remembered) == 1
    with server.database.write() as session:
        store.revoke_key(session, key_id(key))
        store.add_key(session, name="other", scopes=("read:stream",))
    assert server.ask("GET", "/api/v1/devices", key).status_code == 401
    assert len(remembered) == 0
