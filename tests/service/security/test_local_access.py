"""Who needs no key: programs of the server's own machine, while only it can reach the server."""

from typing import Any

import pytest
from starlette.datastructures import Headers

from service.security.credential import is_loopback, keys_required, why_not_local
from service.settings import Settings
from tests.service.fake_pipeline import TestClient

DEFAULT = Settings()


@pytest.mark.parametrize("host", ["127.0.0.1", "127.8.9.10", "::1", "localhost", "LocalHost."])
def test_loopback(host: str) -> None:
    assert is_loopback(host)
    assert not keys_required(Settings(host=host))


@pytest.mark.parametrize(
    "host", ["0.0.0.0", "::", "192.168.1.7", "lumiline.local", "127.0.0.1.evil.example", ""]
)
def test_a_server_that_others_can_reach_needs_keys(host: str) -> None:
    assert not is_loopback(host)
    assert keys_required(Settings(host=host))
    headers = Headers({"host": "localhost:8000"})
    assert why_not_local(Settings(host=host), "127.0.0.1", headers) is not None


def test_keys_can_be_asked_for() -> None:
    assert not keys_required(DEFAULT)
    assert keys_required(Settings(authentication="required"))
    assert keys_required(Settings(trusted_proxies=("127.0.0.1",)))


@pytest.mark.parametrize("client", ["127.0.0.1", "::1"])
@pytest.mark.parametrize("host", ["localhost", "localhost:8000", "127.0.0.1:9", "[::1]:8000"])
def test_a_local_program_needs_none(client: str, host: str) -> None:
    assert why_not_local(DEFAULT, client, Headers({"host": host})) is None


@pytest.mark.parametrize(
    ("client", "headers", "part"),
    [
        ("10.0.0.9", {"host": "localhost"}, "10.0.0.9"),
        ("unknown", {"host": "localhost"}, "unknown"),
        ("127.0.0.1", {"host": "rebound.example:8000"}, "rebound.example"),
        ("127.0.0.1", {"host": "localhost.evil.example"}, "evil.example"),
        ("127.0.0.1", {"host": "localhost@evil.example"}, "evil.example"),
        ("127.0.0.1", {"host": "evil.example#@localhost"}, "evil.example"),
        ("127.0.0.1", {"host": ""}, "Host"),
        ("127.0.0.1", {}, "Host"),
        ("127.0.0.1", {"host": "localhost", "x-forwarded-for": "127.0.0.1"}, "x-forwarded-for"),
        ("127.0.0.1", {"host": "localhost", "x-forwarded-proto": "https"}, "x-forwarded-proto"),
        ("127.0.0.1", {"host": "localhost", "forwarded": "for=127.0.0.1"}, "forwarded"),
        ("127.0.0.1", {"host": "localhost", "via": "1.1 proxy"}, "via"),
        ("127.0.0.1", {"host": "localhost", "x-real-ip": "10.0.0.9"}, "x-real-ip"),
    ],
)
def test_others_are_told_why(client: str, headers: dict[str, str], part: str) -> None:
    reason = why_not_local(DEFAULT, client, Headers(headers))
    assert reason is not None
    assert part in reason


def test_two_hosts_are_none() -> None:
    raw = [(b"host", b"localhost"), (b"host", b"localhost")]
    assert why_not_local(DEFAULT, "127.0.0.1", Headers(raw=raw)) is not None


def test_requests_say_so(sqlite_client: Any) -> None:
    assert sqlite_client.get("/api/v1/devices").status_code == 200
    refused = sqlite_client.get("/api/v1/devices", headers={"host": "rebound.example"})
    assert refused.status_code == 401
    assert "rebound.example" in refused.json()["detail"]
    assert "docs/how-to/security.md" in refused.json()["detail"]
    # A key that is wrong is refused also where none is needed.
    wrong = sqlite_client.get("/api/v1/devices", headers={"authorization": "Bearer wrong"})
    assert wrong.status_code == 401
    for header in ("Basic dXNlcjpwYXNz", "Bearer", "Bearer a b", "", "lumi_a_b"):
        answer = sqlite_client.get("/api/v1/devices", headers={"authorization": header})
        assert answer.status_code == 401, header
    outside = TestClient(sqlite_client.app, client=("10.0.0.9", 1234))
    assert outside.get("/api/v1/devices").status_code == 401
    assert outside.get("/healthz").status_code == 200


QUERIES = (
    "api_key=abc",
    "device_id=sim&access_token=abc",
    "Token=abc",
    "limit=lumi_abcdefghijkl_ABC",
    "lumi_abcdefghijkl_ABC",
    "x=eyJhbGciOiJub25lIn0.eyJzdWIiOiJhIn0.",
)


def test_a_key_in_an_address_is_refused_and_not_repeated(sqlite_client: Any) -> None:
    for path in ("/api/v1/devices", "/healthz"):
        for query in QUERIES:
            refused = sqlite_client.get(f"{path}?{query}")
            assert refused.status_code == 400, query
            assert refused.json()["type"] == "/problems/credential-in-query"
            assert "abc" not in refused.text
            assert "eyJ" not in refused.text
