"""Members of a query that nobody knows are refused, on every route."""

import json
from typing import Any

import pytest
from fastapi.routing import iter_route_contexts
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from service.security.query_members import query_members


def refusal(answer: Any) -> dict[str, Any]:
    assert answer.status_code == 422, answer.text
    problem: dict[str, Any] = answer.json()
    assert problem["type"] == "/problems/unknown-query-member"
    return problem


def test_every_route_refuses_what_it_does_not_know(sqlite_client: Any) -> None:
    asked = 0
    for route in iter_route_contexts(sqlite_client.app.routes):
        path = str(route.path)
        for name in ("device_id", "recording_id", "path"):
            path = path.replace(f"{{{name}}}", "sim").replace(f"{{{name}:path}}", "sim")
        path = path.replace("{", "").replace("}", "")
        for method in route.methods or ():
            answer = sqlite_client.request(method, path, params={"no_such_name": "1"})
            if method == "HEAD":
                assert answer.status_code == 422, path
                continue
            problem = refusal(answer)
            assert '"no_such_name"' in problem["detail"], path
            assert problem["context"]["known"] == list(query_members(route) or ())
            asked += 1
    assert asked > 120


def test_the_known_names_are_told(sqlite_client: Any) -> None:
    problem = refusal(
        sqlite_client.get("/api/v1/runs", params={"state": "queued", "device": "sim"})
    )
    assert problem["detail"] == (
        'the query has "device", which is not known here; known are device_id, kind, state, limit, '
        "cursor"
    )
    assert "takes none" in refusal(sqlite_client.get("/healthz?verbose"))["detail"]
    assert sqlite_client.get("/api/v1/runs?state=queued&device_id=sim").status_code == 200


def test_a_long_name_is_cut(sqlite_client: Any) -> None:
    problem = refusal(sqlite_client.get("/healthz", params={"x" * 3000: "1"}))
    assert len(problem["detail"]) < 300


def test_who_may_not_ask_is_told_that_first(sqlite_client: Any) -> None:
    headers = {"authorization": "Bearer lumi_nobody_nothing"}
    answer = sqlite_client.get("/api/v1/devices?no_such_name=1", headers=headers)
    assert answer.status_code == 401


def test_a_path_that_there_is_not_is_not_found(sqlite_client: Any) -> None:
    assert sqlite_client.get("/api/v1/nowhere?no_such_name=1").status_code == 404


def test_the_stream_refuses_it_too(server: str) -> None:
    url = f"{server.replace('http', 'ws', 1)}/api/v1/stream?device_id=sim&rate=5"
    with pytest.raises(InvalidStatus) as caught, connect(url):
        pass
    problem = json.loads(caught.value.response.body or b"")
    assert problem["type"] == "/problems/unknown-query-member"
    assert "rate_hz" in problem["context"]["known"]
