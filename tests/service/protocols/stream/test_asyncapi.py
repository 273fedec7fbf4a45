"""The AsyncAPI document: valid, served, and true of real messages."""

import copy
import json
from pathlib import Path
from typing import Any

import httpx
import jsonschema_rs
import pytest

from service.protocols.stream.asyncapi import PATH, document
from tests.service.protocols.stream.test_stream import receive, streaming

# Of @asyncapi/specs 6.11.1, Apache License 2.0.
SPECIFICATION = json.loads(Path(__file__).with_name("asyncapi_3_0_0.json").read_text("utf-8"))


def errors_of(found: dict[str, Any]) -> list[str]:
    return [one.message for one in jsonschema_rs.validator_for(SPECIFICATION).iter_errors(found)]


def validator(name: str) -> Any:
    schema = {"$ref": f"#/components/schemas/{name}", "components": document()["components"]}
    return jsonschema_rs.validator_for(schema)


def schema_of(message: dict[str, Any]) -> str:
    payload = document()["components"]["messages"][message["type"]]["payload"]["$ref"]
    return str(payload.rpartition("/")[2])


def check_fits(message: dict[str, Any]) -> None:
    found = validator(schema_of(message))
    assert [one.message for one in found.iter_errors(message)] == []
    without = {name: value for name, value in message.items() if name != "device_id"}
    assert not found.is_valid(without)


def test_the_document_is_one() -> None:
    assert errors_of(document()) == []
    for part in ("info", "channels"):
        wrong = copy.deepcopy(document())
        wrong[part] = 7
        assert errors_of(wrong) != []


def test_no_reference_dangles() -> None:
    found = document()

    def check(node: Any) -> None:
        if isinstance(node, dict):
            if isinstance(node.get("$ref"), str):
                target: Any = found
                for name in node["$ref"].removeprefix("#/").split("/"):
                    target = target[name]
            for value in node.values():
                check(value)
        elif isinstance(node, list):
            for value in node:
                check(value)

    check(found)


def test_it_is_served_to_everyone(sqlite_client: Any) -> None:
    answer = sqlite_client.get(PATH)
    assert (answer.status_code, answer.json()) == (200, document())


@pytest.mark.slow
@pytest.mark.parametrize("bundle", ["", "&bundle_ms=50"])
def test_real_messages_fit_it(server: str, bundle: str) -> None:
    query = f"device_id=sim&encoding=json&content=points,peaks,tracks,tools,holds{bundle}"
    kinds = set()
    with streaming(server, query) as websocket:
        for _ in range(20):
            message = receive(websocket)
            kinds.add(message["type"])
            check_fits(message)
    assert kinds >= {"hello", "frames" if bundle else "frame"}


def test_changes_of_the_state_fit_it(server: str) -> None:
    url = f"{server}/api/v1/devices/sim"
    httpx.post(f"{url}/start", timeout=60.0).raise_for_status()
    with streaming(server, "device_id=sim&encoding=json&content=state") as websocket:
        check_fits(receive(websocket))
        httpx.post(f"{url}/stop").raise_for_status()
        httpx.post(f"{url}/start", timeout=60.0).raise_for_status()
        for state in ("stopped", "starting", "running"):
            message = receive(websocket)
            check_fits(message)
            assert (message["type"], message["state"]) == ("state", state)


def test_real_members_are_all_described(server: str) -> None:
    with streaming(server, "device_id=sim&encoding=json&content=points,peaks") as websocket:
        for _ in range(3):
            message = receive(websocket)
            schema = document()["components"]["schemas"][schema_of(message)]
            assert message.keys() <= schema["properties"].keys()
