"""Changes of the contract that break clients are found; additions pass."""

import copy
import importlib.util
import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
FILE = ROOT / "docs" / "generators" / "contract.py"
_SPEC = importlib.util.spec_from_file_location("contract_generator", FILE)
assert _SPEC is not None
assert _SPEC.loader is not None
contract = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(contract)

Change = Callable[[dict[str, Any]], None]


def document() -> dict[str, Any]:
    """A contract of one resource."""

    def content(name: str) -> dict[str, Any]:
        return {"application/json": {"schema": {"$ref": f"#/components/schemas/{name}"}}}

    text = {"type": "string"}
    return {
        "paths": {
            "/things": {
                "post": {
                    "operationId": "create-thing",
                    "parameters": [{"name": "note", "in": "query", "schema": text}],
                    "requestBody": {"content": content("NewThing")},
                    "responses": {"201": {"content": content("Thing")}, "409": {}},
                }
            }
        },
        "components": {
            "schemas": {
                "NewThing": {
                    "properties": {
                        "name": text,
                        "kind": {"enum": ["a", "b"]},
                        "size": {"type": "integer"},
                    },
                    "required": ["name"],
                },
                "Thing": {
                    "properties": {"name": text, "kind": {"enum": ["a", "b"]}, "part": text},
                    "required": ["name", "kind"],
                },
            }
        },
    }


def changes(change: Change) -> list[str]:
    before, now = document(), copy.deepcopy(document())
    change(now)
    return list(contract.breaking_changes(contract.shape(before), contract.shape(now)))


def schema(found: dict[str, Any], name: str) -> Any:
    return found["components"]["schemas"][name]


def post(found: dict[str, Any]) -> Any:
    return found["paths"]["/things"]["post"]


BREAKING: dict[str, tuple[Change, str]] = {
    "operation": (lambda d: d["paths"].clear(), "operation create-thing (POST /things) is gone"),
    "path": (
        lambda d: d["paths"].update({"/others": d["paths"].pop("/things")}),
        "operation create-thing is POST /others, was POST /things",
    ),
    "parameter": (
        lambda d: post(d)["parameters"].clear(),
        "operation create-thing: parameter query note is gone",
    ),
    "required parameter": (
        lambda d: post(d)["parameters"][0].update(required=True),
        "operation create-thing: parameter query note is required",
    ),
    "answer": (
        lambda d: post(d)["responses"].update({"202": post(d)["responses"].pop("201")}),
        "operation create-thing answers no 201",
    ),
    "member of an answer": (
        lambda d: schema(d, "Thing")["properties"].pop("part"),
        "Thing.part is gone",
    ),
    "member of a request": (
        lambda d: schema(d, "NewThing")["properties"].pop("size"),
        "NewThing.size is gone",
    ),
    "required member of a request": (
        lambda d: schema(d, "NewThing")["required"].append("size"),
        "NewThing.size is required in requests",
    ),
    "new required member of a request": (
        lambda d: (
            schema(d, "NewThing")["properties"].update(more={"type": "string"}),
            schema(d, "NewThing")["required"].append("more"),
        ),
        "NewThing.more is required in requests",
    ),
    "member that may be absent": (
        lambda d: schema(d, "Thing")["required"].remove("kind"),
        "Thing.kind may be absent from answers",
    ),
    "value of an enumeration": (
        lambda d: schema(d, "NewThing")["properties"]["kind"]["enum"].remove("b"),
        'NewThing.kind takes "b" no more',
    ),
    "type of a member": (
        lambda d: schema(d, "NewThing")["properties"].update(size={"type": "string"}),
        "NewThing.size takes integer no more",
    ),
    "null in an answer": (
        lambda d: schema(d, "Thing")["properties"].update(
            name={"anyOf": [{"type": "string"}, {"type": "null"}]}
        ),
        "Thing.name may be null",
    ),
}


@pytest.mark.parametrize("name", BREAKING)
def test_what_breaks_clients_is_found(name: str) -> None:
    change, line = BREAKING[name]
    assert line in changes(change)


ADDITIONS: dict[str, Change] = {
    "nothing": lambda d: None,
    "operation": lambda d: d["paths"].update(
        {"/others": {"get": {"operationId": "list-others", "responses": {"200": {}}}}}
    ),
    "parameter": lambda d: post(d)["parameters"].append(
        {"name": "more", "in": "query", "schema": {"type": "string"}}
    ),
    "member of an answer": lambda d: schema(d, "Thing")["properties"].update(
        more={"type": "string"}
    ),
    "optional member of a request": lambda d: schema(d, "NewThing")["properties"].update(
        more={"type": "string"}
    ),
    "value of an enumeration": lambda d: schema(d, "Thing")["properties"]["kind"]["enum"].append(
        "c"
    ),
    "wider type of a request": lambda d: schema(d, "NewThing")["properties"].update(
        size={"type": "number"}
    ),
    "description": lambda d: schema(d, "Thing")["properties"]["part"].update(description="new"),
}


@pytest.mark.parametrize("name", ADDITIONS)
def test_additions_pass(name: str) -> None:
    assert changes(ADDITIONS[name]) == []


def test_snapshot_is_as_written() -> None:
    text = contract.SNAPSHOT.read_text(encoding="utf-8")
    assert contract.written(json.loads(text)) == text


@pytest.mark.slow
def test_the_contract_is_that_of_the_snapshot() -> None:
    command = [sys.executable, FILE, "--check"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
