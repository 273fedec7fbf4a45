"""Every route with every credential: allowed where docs/how-to/security.md says so.

Credentials are keys of one scope, of all but one, of the sets that the guide proposes and of the
former scopes as the migration replaces them; none, and keys that are not valid.
"""

import time
from collections.abc import Iterator
from concurrent.futures import CancelledError
from contextlib import contextmanager, suppress
from typing import Any

import pytest
from starlette.websockets import WebSocketDisconnect

from migrations.versions.v0013_scopes import REPLACED
from service.principal import SCOPES
from service.security.credential import BEARER_SUBPROTOCOL, SUBPROTOCOL
from tests.service.fake_pipeline import WebSocketDenialResponse
from tests.service.security.conftest import Secured
from tests.service.security.documented_scopes import Row, documented, documented_tasks

ROWS = documented()
HTTP = [row for row in ROWS if row.method != "websocket"]
SOCKETS = [row for row in ROWS if row.method == "websocket"]

# What cannot be read as a key, and a key of the right form that was never given out.
WRONG = ("nonsense", "lumi_" + "a" * 12 + "_" + "b" * 43)


CREDENTIALS: dict[str, frozenset[str]] = {
    **{scope: frozenset({scope}) for scope in SCOPES},
    **{f"all but {scope}": frozenset(SCOPES) - {scope} for scope in SCOPES},
    **documented_tasks(),
    **{f"former {scope}": frozenset(scopes) for scope, scopes in REPLACED.items()},
}
"""Scopes of the valid keys by name."""


@pytest.fixture(scope="module")
def keys(secured: Secured) -> dict[str, str]:
    """A key of each set of scopes."""
    return {name: secured.key(*scopes) for name, scopes in CREDENTIALS.items()}  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def invalid(secured: Secured) -> list[str]:
    return [secured.expired(*SCOPES), secured.revoked(*SCOPES), *WRONG]


def ask(secured: Secured, row: Row, key: str | None) -> Any:
    # Names of nothing: where it is allowed, nothing is found and nothing happens.
    path = row.path
    for name in ("{code}", "{figure}", "{name}"):
        path = path.replace(name, "nothing")
    while "{" in path:
        path = path[: path.index("{")] + "nothing" + path[path.index("}") + 1 :]
    return secured.ask(row.method, path, key)


@pytest.mark.slow
@pytest.mark.parametrize("row", HTTP, ids=lambda row: row.operation)
def test_every_operation(
    secured: Secured, keys: dict[str, str], invalid: list[str], row: Row
) -> None:
    if row.scope == "public":
        # Also with a key that is not valid: nothing looks at it.
        for key in (None, *WRONG):
            assert ask(secured, row, key).status_code not in (401, 403)
        return
    for key in (None, *invalid):
        refused = ask(secured, row, key)
        assert refused.status_code == 401, (row, key, refused.text)
        assert refused.json()["type"] == "/problems/unauthenticated"
        assert refused.headers["www-authenticate"] == 'Bearer realm="lumiline"'
        assert key is None or key not in refused.text
    for name, key in keys.items():
        answer = ask(secured, row, key)
        if row.scope in CREDENTIALS[name]:
            assert answer.status_code not in (401, 403, 500), (row, name, answer.text)
        else:
            assert answer.status_code == 403, (row, name, answer.text)
            assert answer.json()["type"] == "/problems/missing-scope"
            assert answer.json()["context"]["scope"] == row.scope
            assert f'scope="{row.scope}"' in answer.headers["www-authenticate"]


def handshake(secured: Secured, row: Row, key: str | None, *, by_header: bool) -> int:
    """Open a websocket and close it; return the status of the answer."""
    path = "/nowhere" if row.path == "any other path" else f"{row.path}?device_id=sim"
    options: dict[str, Any] = {}
    if key is not None and by_header:
        options = {"headers": {"authorization": f"Bearer {key}"}}
    elif key is not None:
        options = {"subprotocols": [SUBPROTOCOL, f"{BEARER_SUBPROTOCOL}{key}"]}
    status = 0
    try:
        with (
            ended_by_the_client(),
            secured.client.websocket_connect(path, **options) as socket,
        ):
            # Of what was offered the key is not sent back.
            named = SUBPROTOCOL if "subprotocols" in options else None
            assert socket.accepted_subprotocol == named
            socket.close()
            wait_until_closed(secured)
            status = 101
    except WebSocketDenialResponse as denied:
        return int(denied.status_code)
    except WebSocketDisconnect as closed:
        pytest.fail(f"closed with {closed.code} instead of an answer")
    return status


@contextmanager
def ended_by_the_client() -> Iterator[None]:
    """Let pass how the test client ends a session that the server has closed already."""
    with suppress(CancelledError):
        yield


def wait_until_closed(secured: Secured) -> None:
    """Wait for the server's side: the test client would cancel it half way."""
    end = time.monotonic() + 240.0
    while len(secured.client.app.state.open_streams):
        assert time.monotonic() < end
        time.sleep(0.005)
    time.sleep(0.02)


@pytest.mark.parametrize("by_header", [True, False], ids=["header", "subprotocol"])
@pytest.mark.parametrize("row", SOCKETS, ids=lambda row: row.operation)
def test_every_websocket(
    secured: Secured, keys: dict[str, str], invalid: list[str], row: Row, by_header: bool
) -> None:
    if row.scope == "public":
        assert handshake(secured, row, None, by_header=by_header) == 404
        return
    for key in (None, *invalid):
        assert handshake(secured, row, key, by_header=by_header) == 401
    for name, key in keys.items():
        expected = 101 if row.scope in CREDENTIALS[name] else 403
        assert handshake(secured, row, key, by_header=by_header) == expected


def test_what_there_is_not_is_not_found_for_everyone(secured: Secured) -> None:
    for path in ("/nowhere", "/api/v1/devices/", "/api/v1//devices", "/API/V1/devices"):
        answer = secured.ask("GET", path)
        assert answer.status_code == 404
    assert secured.ask("PUT", "/api/v1/devices").status_code == 405


@pytest.mark.parametrize("path", ["/api/v1/devices", "/api/v1/%64evices", "//api/v1/devices"])
def test_other_spellings_of_a_path_are_no_way_around(secured: Secured, path: str) -> None:
    for method in ("GET", "HEAD"):
        assert secured.ask(method, f"http://localhost{path}").status_code in (401, 404)


def test_authorisation_comes_before_the_body_is_looked_at(secured: Secured) -> None:
    for body in (b"{", b'{"a": 1, "a": 2}', b"\xff", b"x" * (9 * 1024 * 1024)):
        options = {"content": body, "headers": {"content-type": "application/json"}}
        assert secured.ask("POST", "/api/v1/devices", **options).status_code == 401
    refused = secured.ask("POST", "/api/v1/devices", secured.key("read:stream"), content=b"{")
    assert refused.status_code == 403
