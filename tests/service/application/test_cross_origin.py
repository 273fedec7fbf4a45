"""Requests of web pages of another origin: nothing is changed and no stream opened."""

from typing import Any

import pytest

from service.application.middleware import same_host
from tests.service.fake_pipeline import FakePipeline, WebSocketDenialResponse

OWN = "http://localhost"
OTHERS = ["http://evil.example", "http://localhost:81", "http://localhost.evil.example", "null"]
STREAM = "/api/v1/stream?device_id=sim"


def assert_refused(answer: Any) -> None:
    assert answer.status_code == 403
    assert answer.headers["content-type"] == "application/problem+json"
    assert answer.json()["type"] == "/problems/cross-origin"


@pytest.mark.parametrize("origin", OTHERS)
@pytest.mark.parametrize(
    ("method", "path"),
    [
        ("POST", "/api/v1/devices/sim/stop"),
        ("PATCH", "/api/v1/devices/sim"),
        ("DELETE", "/api/v1/devices/sim?cascade=true"),
        ("PUT", "/nowhere"),
    ],
)
def test_an_unsafe_request_of_another_origin_is_not_executed(
    sqlite_client: Any, live: FakePipeline, origin: str, method: str, path: str
):
    before = list(live.calls)
    assert_refused(sqlite_client.request(method, path, headers={"origin": origin}))
    assert live.calls == before
    assert sqlite_client.get("/api/v1/devices/sim").status_code == 200


def test_one_foreign_origin_among_several_is_enough(sqlite_client: Any):
    headers = [("origin", OWN), ("origin", "http://evil.example")]
    assert_refused(sqlite_client.post("/api/v1/devices/sim/stop", headers=headers))


def test_programs_and_the_servers_own_pages_may(sqlite_client: Any):
    path = "/api/v1/devices/sim/stop"
    assert sqlite_client.post(path).status_code == 200
    for origin in (OWN, "http://LocalHost:80", "https://localhost"):
        assert sqlite_client.post(path, headers={"origin": origin}).status_code == 200


@pytest.mark.parametrize("method", ["GET", "HEAD"])
def test_reading_needs_no_refusal(sqlite_client: Any, method: str):
    # A page of another origin cannot see the answer: it has no Access-Control-Allow-Origin.
    answer = sqlite_client.request(method, "/api/v1/devices", headers={"origin": OTHERS[0]})
    assert answer.status_code == 200
    assert "access-control-allow-origin" not in answer.headers


@pytest.mark.parametrize("origin", OTHERS)
def test_a_stream_for_another_origin_is_not_opened(sqlite_client: Any, origin: str):
    with (
        pytest.raises(WebSocketDenialResponse) as refused,
        sqlite_client.websocket_connect(STREAM, headers={"origin": origin}),
    ):
        pass
    assert_refused(refused.value)


@pytest.mark.parametrize("headers", [{}, {"origin": OWN}])
def test_a_stream_for_programs_and_own_pages_reaches_it(
    sqlite_client: Any, headers: dict[str, str]
):
    with (
        pytest.raises(WebSocketDenialResponse) as refused,
        sqlite_client.websocket_connect("/api/v1/stream", headers=headers),
    ):
        pass
    # It is the stream that misses the query's device.
    assert refused.value.json()["type"] == "/problems/invalid-parameter"


def test_a_path_without_websocket_says_so(sqlite_client: Any):
    for path in ("/api/v1/streams", "/api/v1/devices", "/"):
        with (
            pytest.raises(WebSocketDenialResponse) as refused,
            sqlite_client.websocket_connect(path),
        ):
            pass
        assert refused.value.status_code == 404
        assert refused.value.headers["content-type"] == "application/problem+json"
        problem = refused.value.json()
        assert (problem["type"], problem["instance"]) == ("/problems/not-found", path)
        assert "/api/v1/stream" in problem["detail"]


@pytest.mark.parametrize(
    ("origin", "host", "same"),
    [
        ("http://localhost:8000", "localhost:8000", True),
        ("http://localhost:8000", "LOCALHOST:8000", True),
        ("http://[::1]:8000", "[::1]:8000", True),
        ("http://lab.example", "lab.example:80", True),
        ("https://lab.example", "lab.example", True),
        ("https://lab.example", "lab.example:80", False),
        ("http://localhost:8001", "localhost:8000", False),
        ("http://127.0.0.1:8000", "localhost:8000", False),
        ("http://localhost:8000@evil.example", "localhost:8000", False),
        ("ftp://localhost:8000", "localhost:8000", False),
        ("file://", "", False),
        ("http://", "", False),
        ("null", "null", False),
        ("", "", False),
        ("http://localhost:99999", "localhost:99999", False),
        ("http://[::1", "[::1", False),
    ],
)
def test_origin_and_host_are_compared_by_name_and_port(origin: str, host: str, same: bool):
    assert same_host(origin, host) is same
