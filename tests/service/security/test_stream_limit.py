"""Open streams: they end when their key does, and a key has no more of them than it may."""

from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest
from sqlalchemy import update
from starlette.websockets import WebSocketDisconnect

from service.database.models import ApiKeyRow
from service.principal import LOCAL, Principal
from service.problems.errors import NotReady, TooManyStreams
from service.security import store
from service.security.stream_limit import StreamLimit
from tests.service.fake_pipeline import WebSocketDenialResponse
from tests.service.security.conftest import Secured, bearer, key_id
from tests.service.security.test_scope_matrix import ended_by_the_client

STREAM = "/api/v1/stream?device_id=sim"


@pytest.fixture(autouse=True)
def checked_often(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("service.protocols.stream.router.ACCESS_CHECK_INTERVAL_S", 0.02)


@contextmanager
def streaming(secured: Secured, key: str) -> Iterator[Any]:
    with (
        ended_by_the_client(),
        secured.client.websocket_connect(STREAM, headers=bearer(key)) as socket,
    ):
        socket.receive_bytes()  # hello
        yield socket


def close_of(socket: Any) -> tuple[int, str]:
    """Return how a stream ends, after what it still sends."""
    try:
        while True:
            socket.receive_bytes()
    except WebSocketDisconnect as closed:
        return closed.code, closed.reason


def test_a_revoked_key_ends_its_streams(secured: Secured) -> None:
    key, other = secured.key("read:stream"), secured.key("read:stream")
    with streaming(secured, key) as socket, streaming(secured, other):
        with secured.database.write() as session:
            store.revoke_key(session, key_id(key))
        assert close_of(socket) == (1008, "the key was revoked")
        assert len(secured.client.app.state.open_streams) == 1


def test_a_key_that_expires_ends_its_streams(secured: Secured) -> None:
    key = secured.key("read:stream")
    with secured.database.write() as session:
        soon = datetime.now(UTC) + timedelta(seconds=0.5)
        query = update(ApiKeyRow).where(ApiKeyRow.id == key_id(key))
        session.execute(query.values(expires_at=soon))
    with streaming(secured, key) as socket:
        assert close_of(socket) == (1008, "the key has expired")


def test_a_database_that_does_not_answer_ends_no_stream(
    secured: Secured, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []

    def no_answer(principal: Principal) -> str | None:
        asked.append(principal)
        if len(asked) < 4:
            raise NotReady("no answer")
        return "the key was revoked"

    monkeypatch.setattr(secured.client.app.state.authenticator, "why_ended", no_answer)
    with streaming(secured, secured.key("read:stream")) as socket:
        assert close_of(socket) == (1008, "the key was revoked")
    assert len(asked) == 4


def test_a_key_has_so_many_streams(secured: Secured, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(secured.client.app.state, "open_streams", StreamLimit(1))
    key = secured.key("read:stream")
    with streaming(secured, key):
        with pytest.raises(WebSocketDenialResponse) as refused:
            secured.client.websocket_connect(STREAM, headers=bearer(key)).__enter__()
        assert refused.value.status_code == 429
        assert refused.value.json()["type"] == "/problems/too-many-streams"
        with streaming(secured, secured.key("read:stream")):
            pass


def test_streams_are_counted_down_whatever_ends_them() -> None:
    streams = StreamLimit(2)
    with streams.opened(LOCAL), streams.opened(LOCAL):
        with pytest.raises(TooManyStreams, match="2 open streams"), streams.opened(LOCAL):
            pass
        assert len(streams) == 2
    with pytest.raises(KeyError), streams.opened(LOCAL):
        raise KeyError
    assert len(streams) == 0


@pytest.mark.parametrize("query", ["api_key=KEY", "x=KEY", "access_token=abc"])
def test_a_key_in_the_address_is_refused(secured: Secured, query: str) -> None:
    key = secured.key("read:stream")
    with pytest.raises(WebSocketDenialResponse) as refused:
        secured.client.websocket_connect(f"{STREAM}&{query.replace('KEY', key)}").__enter__()
    assert refused.value.status_code == 400
    assert refused.value.json()["type"] == "/problems/credential-in-query"
    assert key not in refused.value.text


def test_two_keys_are_none(secured: Secured) -> None:
    key = secured.key("read:stream")
    offered = ["lumiline.v1", f"lumiline.bearer.{key}"]
    with pytest.raises(WebSocketDenialResponse) as refused:
        secured.client.websocket_connect(
            STREAM, headers=bearer(key), subprotocols=offered
        ).__enter__()
    assert refused.value.status_code == 401
