"""The client changes what it read: it sends the ETag that it has, and says when that is old."""

import json
from collections.abc import Iterator

import httpx
import pytest

from lumiline.client import Client, ResourceChanged, ServerProblem

PATH = "/api/v1/devices/sim/watch"
WATCH = {"enabled": True, "interval_s": 60.0}


class Resource:
    """A server with one resource, whose ETag is the number of its changes."""

    def __init__(self) -> None:
        self.version = 0
        self.seen: list[tuple[str, str | None]] = []

    def answer(self, request: httpx.Request) -> httpx.Response:
        wanted = request.headers.get("If-Match")
        self.seen.append((request.method, wanted))
        if request.method == "PUT":
            if wanted not in (f'"{self.version}"', "*"):
                problem = {"type": "/problems/precondition-failed", "detail": "changed"}
                return httpx.Response(412, json=problem)
            if json.loads(request.content).get("interval_s") == -1.0:
                return httpx.Response(422, json={"type": "/problems/invalid-request"})
            self.version += 1
        return httpx.Response(200, json=WATCH, headers={"ETag": f'"{self.version}"'})


@pytest.fixture
def resource() -> Resource:
    return Resource()


@pytest.fixture
def client(resource: Resource) -> Iterator[Client]:
    with Client("http://server") as made:
        transport = httpx.MockTransport(resource.answer)
        made._http = httpx.Client(transport=transport, base_url="http://server")
        yield made


def change(client: Client, interval_s: float = 10.0) -> None:
    client.request("PUT", PATH, body={"interval_s": interval_s})


def test_change_sends_the_etag_of_the_last_answer(client: Client, resource: Resource) -> None:
    client.request("GET", PATH)
    change(client)
    change(client)
    assert resource.seen == [("GET", None), ("PUT", '"0"'), ("PUT", '"1"')]


def test_change_of_what_was_not_read_reads_it_first(client: Client, resource: Resource) -> None:
    change(client)
    assert resource.seen == [("GET", None), ("PUT", '"0"')]


def test_change_of_what_somebody_else_changed_raises(client: Client, resource: Resource) -> None:
    client.request("GET", PATH)
    resource.version += 1
    with pytest.raises(ResourceChanged, match="412 precondition-failed: changed"):
        change(client)
    with pytest.raises(ResourceChanged):  # as long as it was not read again
        change(client)
    client.request("GET", PATH)
    change(client)
    assert resource.seen[1:] == [
        ("PUT", '"0"'),
        ("PUT", '"0"'),
        ("GET", None),
        ("PUT", '"1"'),
    ]


def test_refused_change_keeps_the_etag(client: Client, resource: Resource) -> None:
    client.request("GET", PATH)
    with pytest.raises(ServerProblem, match="422"):
        change(client, -1.0)
    resource.version += 1
    with pytest.raises(ResourceChanged):
        change(client)


def test_method_takes_an_etag(client: Client, resource: Resource) -> None:
    client.set_watch("sim", interval_s=10.0, if_match="*")
    assert resource.seen == [("PUT", "*")]


def test_etags_are_forgotten_when_there_are_many(client: Client) -> None:
    for number in range(1100):
        client.request("GET", f"/api/v1/tools/t{number}")
    assert len(client._etags) == 1000
    assert "/api/v1/tools/t1099" in client._etags
