"""HEAD: as GET, without the content."""

import asyncio
from typing import Any

import pytest
from starlette.responses import PlainTextResponse
from starlette.types import Message, Receive, Scope, Send

from service.application.middleware import HeadMiddleware


@pytest.mark.parametrize(
    "path",
    [
        "/",
        "/healthz",
        "/readyz",
        "/problems",
        "/problems/not-found",
        "/openapi.json",
        "/docs",
        "/api/v1/devices",
        "/api/v1/devices/sim",
        "/api/v1/calibrations/sim-nominal",
        "/api/v1/devices/nothing",
        "/api/v1/stream",
        "/nowhere",
        "/api/v1/calibrations?limit=0",
    ],
)
def test_head_answers_as_get_does(sqlite_client: Any, path: str):
    same = {"x-request-id": "same"}
    got, head = sqlite_client.get(path, headers=same), sqlite_client.head(path, headers=same)
    assert head.status_code == got.status_code
    assert dict(head.headers) == dict(got.headers)
    assert int(head.headers["content-length"]) == len(got.content) > 0
    assert head.content == b""


def test_head_where_there_is_no_get(sqlite_client: Any):
    head = sqlite_client.head("/api/v1/devices/sim/start")
    assert (head.status_code, head.headers["allow"], head.content) == (405, "POST", b"")


@pytest.mark.slow
def test_the_contract_does_not_list_it(sqlite_client: Any):
    for item in sqlite_client.get("/openapi.json").json()["paths"].values():
        assert "head" not in item


def test_no_content_leaves_the_application():
    # A server and a client would drop it, too, and hide it from the tests above.
    async def sent() -> list[Message]:
        async def app(scope: Scope, _: Receive, send: Send) -> None:
            assert scope["method"] == "GET"
            await PlainTextResponse("content")(scope, receive, send)

        async def receive() -> Message:
            raise AssertionError("nothing is read")

        async def send(message: Message) -> None:
            messages.append(message)

        messages: list[Message] = []
        await HeadMiddleware(app)({"type": "http", "method": "HEAD"}, receive, send)
        return messages

    start, body = asyncio.run(sent())
    assert (b"content-length", b"7") in start["headers"]
    assert body == {"type": "http.response.body", "body": b""}
