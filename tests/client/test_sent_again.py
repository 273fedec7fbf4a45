"""A request that creates is sent again where its answer was lost: with the same key."""

from collections.abc import Callable

import httpx
import pytest

from lumiline.client import Client, ServerUnreachable

KEY = "Idempotency-Key"


def client_of(answer: Callable[[httpx.Request], httpx.Response]) -> Client:
    made = Client("http://server")
    transport = httpx.MockTransport(answer)
    made._http = httpx.Client(transport=transport, base_url="http://server")
    return made


@pytest.fixture(autouse=True)
def no_pause(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Client, "_sleep", staticmethod(lambda seconds: None))


RUN = {"type": "/problems/request-in-progress", "detail": "wait"}


def test_lost_answer_is_asked_for_again_with_the_same_key() -> None:
    sent: list[tuple[str, bytes]] = []

    def answer(request: httpx.Request) -> httpx.Response:
        sent.append((request.headers[KEY], request.read()))
        if len(sent) == 1:
            raise httpx.RemoteProtocolError("server disconnected")
        if len(sent) < 4:
            return httpx.Response(409, json=RUN)
        return httpx.Response(409, json={"type": "/problems/tool-exists", "detail": "there"})

    with client_of(answer) as client, pytest.raises(Exception, match="409 tool-exists"):
        client.create_tool(id="a", device="sim", title="A", markers_mm=[])
    assert len(sent) == 4
    assert len(set(sent)) == 1
    assert len(sent[0][0]) == 32


def test_each_request_has_a_key_of_its_own() -> None:
    keys: list[str] = []

    def answer(request: httpx.Request) -> httpx.Response:
        keys.append(request.headers[KEY])
        return httpx.Response(409, json={"type": "/problems/tool-exists", "detail": "there"})

    with client_of(answer) as client:
        for key in (None, None, "mine"):
            with pytest.raises(Exception, match="tool-exists"):
                client.create_tool(
                    id="a", device="sim", title="A", markers_mm=[], idempotency_key=key
                )
    assert len(set(keys)) == 3
    assert keys[2] == "mine"


@pytest.mark.parametrize("lost", [httpx.ReadError("reset"), httpx.ConnectError("refused")])
def test_what_may_not_be_repeated_is_sent_once(lost: httpx.TransportError) -> None:
    sent = []

    def answer(request: httpx.Request) -> httpx.Response:
        sent.append(request)
        raise lost

    with client_of(answer) as client, pytest.raises(ServerUnreachable, match=str(lost)):
        client.start_device("sim")
    assert len(sent) == 1
    assert KEY not in sent[0].headers
