"""Client methods without a server: requests, answers, and what both clients share."""

import inspect
from typing import Any

import pytest

from lumiline.client import AsyncClient, Client, UnreadableMessage, models
from lumiline.client.exchange import Blocking, ClientMethod, finish
from lumiline.client.operations import Operations


class Answers(Operations, Blocking):
    """A client whose server gives these answers, one after another."""

    def __init__(self, *answers: Any) -> None:
        self.answers = list(answers)
        self.requests: list[tuple[str, dict[str, Any]]] = []

    async def _request(self, method: str, path: str, **named: Any) -> Any:
        self.requests.append((path, named.get("params") or {}))
        answer = self.answers.pop(0)
        if isinstance(answer, Exception):
            raise answer
        return answer


@pytest.mark.parametrize(
    "page",
    [
        None,
        [],
        {},
        {"items": {}, "next_cursor": None},
        {"items": []},
        {"items": [], "next_cursor": 2},
    ],
)
def test_list_answer_is_no_page_raises(page: Any) -> None:
    with pytest.raises(UnreadableMessage, match="/api/v1/devices did not answer a list"):
        Answers(page).devices()


@pytest.mark.parametrize("answer", [None, [], "state", {}, {"device_id": "sim", "state": {}}])
def test_answer_of_another_model_raises(answer: Any) -> None:
    with pytest.raises(
        UnreadableMessage, match=r"/state did not answer a DeviceStateDocument: .* at "
    ):
        Answers(answer).device_state("sim")


def test_list_of_two_pages_is_requested_from_the_next_item_on() -> None:
    pages = [
        {"items": [{"id": str(n)} for n in part], "next_cursor": cursor}
        for part, cursor in (((0, 1), "behind-1"), ((2,), None))
    ]
    client = Answers(*pages)
    query = {"device_id": "sim"}
    found = finish(client._get_all(models.ResponseModel, "/list", params=query))
    assert [one.model_dump()["id"] for one in found] == ["0", "1", "2"]
    assert [query for _, query in client.requests] == [
        {"device_id": "sim", "limit": 200, "cursor": None},
        {"device_id": "sim", "limit": 200, "cursor": "behind-1"},
    ]


def test_error_of_the_transport_reaches_the_caller() -> None:
    with pytest.raises(OSError, match="cable"):
        Answers(OSError("cable")).devices()


def test_recording_name_with_a_slash_is_part_of_the_path() -> None:
    client = Answers({})
    with pytest.raises(UnreadableMessage):
        client.recording("day 1/a.h5")
    assert client.requests[0][0] == "/api/v1/recordings/day%201/a.h5"


def public(kind: type[Any]) -> dict[str, Any]:
    return {
        name: member
        for name, member in inspect.getmembers(kind, inspect.isfunction)
        if not name.startswith("_")
    }


def test_both_clients_have_the_same_methods() -> None:
    blocking, awaitable = public(Client), public(AsyncClient)
    assert blocking.keys() == awaitable.keys()
    assert len(blocking) > 40
    for name, method in blocking.items():
        other = awaitable[name]
        if name != "stream":  # returns a stream of either kind at once
            assert not inspect.iscoroutinefunction(method), name
            assert inspect.iscoroutinefunction(other), name
            assert inspect.signature(method) == inspect.signature(other), name
        if name != "close":
            assert inspect.getdoc(method) == inspect.getdoc(other), name


def test_every_method_is_written_once() -> None:
    own = {"close", "_http_type", "_stream_type", "_sleep", "_pieces", "_end"}
    for kind in (Client, AsyncClient):
        assert {name for name in vars(kind) if not name.startswith("__")} == own
        methods = {
            name: next(vars(base)[name] for base in kind.__mro__ if name in vars(base))
            for name in public(kind)
        }
        shared = {name for name, one in methods.items() if isinstance(one, ClientMethod)}
        assert methods.keys() - shared == {"close", "stream"}


def test_signature_of_a_method_names_its_result() -> None:
    signature = inspect.signature(Client.device_state)
    assert list(signature.parameters) == ["self", "device_id"]
    assert signature.return_annotation is models.DeviceStateDocument
    assert Client.device_state.__doc__ == "What a device is doing."


def test_models_of_answers_are_in_one_module() -> None:
    kinds = {
        kind
        for kind in models.ResponseModel.__subclasses__()
        if kind.__module__.startswith("lumiline.")
    }
    assert len(kinds) > 20
    assert {kind.__module__ for kind in kinds} == {"lumiline.client.models"}
