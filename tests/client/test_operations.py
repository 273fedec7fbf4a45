"""The client's methods are the operations of the OpenAPI document: all of them, as it says."""

import inspect
import json
import re
import subprocess
import sys
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from lumiline.client import Client, ServerProblem, bodies, models
from lumiline.client.exchange import ClientMethod
from lumiline.client.operations import Operations
from tests.openapi_document import openapi_document

BEYOND_THE_INTERFACE = {"request", "stream", "wait_for_run", "close"}
"""Methods that are no operation's."""
PAGING = {"limit", "cursor"}

GENERATOR = Path(__file__).parents[2] / "docs" / "generators" / "client_code.py"


def method_name(operation_id: str) -> str:
    return operation_id.removeprefix("list-").removeprefix("get-").replace("-", "_")


def operations() -> Iterator[tuple[str, str, dict[str, Any]]]:
    for path, verbs in openapi_document()["paths"].items():
        for verb, operation in verbs.items():
            yield path, verb.upper(), operation


OPERATIONS = {operation["operationId"]: (path, verb, operation)
              for path, verb, operation in operations()}  # fmt: skip


def test_every_operation_has_a_method_and_every_method_is_one() -> None:
    methods = {name for name in dir(Client) if not name.startswith("_")} - BEYOND_THE_INTERFACE
    assert methods == {method_name(operation) for operation in OPERATIONS}


@pytest.mark.slow
def test_generated_code_is_that_of_the_document() -> None:
    done = subprocess.run(
        [sys.executable, str(GENERATOR), "--check"], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr


def signature(operation_id: str) -> inspect.Signature:
    return inspect.signature(getattr(Client, method_name(operation_id)))


def argument_of(parameter: inspect.Parameter, tmp_path: Path) -> Any:
    """Return an argument that is recognised in a request."""
    if parameter.annotation == Path | str:
        file = tmp_path / "file"
        file.write_bytes(b"content")
        return file
    return 7 if "int" in str(parameter.annotation) or "float" in str(parameter.annotation) else (
        f"a {parameter.name}/b"
    )  # fmt: skip


@pytest.mark.parametrize("operation_id", OPERATIONS)
def test_method_sends_the_request_of_its_operation(operation_id: str, tmp_path: Path) -> None:
    path, verb, operation = OPERATIONS[operation_id]
    requests: list[httpx.Request] = []

    def refuse(request: httpx.Request) -> httpx.Response:
        request.read()
        requests.append(request)
        return httpx.Response(418, json={"type": "x/teapot", "detail": "short"})

    parameters = list(signature(operation_id).parameters.values())[1:]
    named = [one for one in parameters if one.kind is one.KEYWORD_ONLY]
    given = {one.name: argument_of(one, tmp_path) for one in named}
    at = [argument_of(one, tmp_path) for one in parameters
          if one.kind in (one.POSITIONAL_ONLY, one.POSITIONAL_OR_KEYWORD)]  # fmt: skip
    members = {"a": 1, "b": None} if any(one.kind is one.VAR_KEYWORD for one in parameters) else {}
    with Client("http://server") as client:
        client._http = httpx.Client(transport=httpx.MockTransport(refuse), base_url="http://server")
        with pytest.raises(ServerProblem, match="418 teapot"):
            getattr(client, method_name(operation_id))(*at, **given, **members)
    (request,) = requests
    assert request.method == verb
    placed = [f"a {name}/b" for name in re.findall(r"{(\w+)}", path)]
    assert httpx.URL(str(request.url)).path == re.sub(r"{\w+}", "{}", path).format(*placed)
    expected = {
        one["name"]: one["in"]
        for one in operation.get("parameters", ())
        if one["in"] != "path" and one["name"] != "If-None-Match"
    }
    queried = {name for name, where in expected.items() if where == "query"}
    assert set(request.url.params) == queried - {"cursor"}
    for name in queried - PAGING:
        assert request.url.params[name] in ("7", f"a {name}/b")
    for name in {name for name, where in expected.items() if where == "header"}:
        assert request.headers[name]
    content = operation.get("requestBody", {}).get("content", {})
    if "application/json" in content:
        assert json.loads(request.content) == members
        assert request.headers["Content-Type"] == "application/json"
    else:
        assert request.content == (b"content" if content else b"")
        assert not content or request.headers["Content-Type"] in content


def schema(name: str) -> dict[str, Any]:
    """Return a schema by its type's name, which leaves the module out."""
    schemas = openapi_document()["components"]["schemas"]
    found = [one for full, one in schemas.items() if full.rsplit("__", 1)[-1] == name]
    for full, one in schemas.items():
        *modules, last = full.split("__")
        of = [part for part in modules if part != "schema"][-1:]
        if of and name.endswith(last) and name.lower().startswith(of[0].split("_")[0]):
            found.append(one)
    return found[0]


TYPES = [
    one
    for module in (models, bodies)
    for one in vars(module).values()
    if inspect.isclass(one)
    and one.__module__ == module.__name__
    and one is not models.ResponseModel
]


@pytest.mark.parametrize("kind", TYPES, ids=lambda kind: f"{kind.__module__[16:]}-{kind.__name__}")
def test_type_has_the_members_of_its_schema(kind: type[Any]) -> None:
    found = schema(kind.__name__)
    kinds = [schema(one["$ref"].rsplit("/", 1)[-1]) for one in found.get("oneOf", ())] or [found]
    members = set().union(*(one["properties"] for one in kinds))
    required = set.intersection(*(set(one.get("required", ())) for one in kinds))
    if kind.__module__ == models.__name__:
        assert set(kind.model_fields) == members
        assert {n for n, one in kind.model_fields.items() if one.is_required()} == required
    else:
        assert typing.is_typeddict(kind)
        assert set(kind.__annotations__) == members
        assert kind.__required_keys__ == required


def test_all_methods_are_written_once_as_client_methods() -> None:
    methods = {name: one for name, one in vars(Operations).items() if not name.startswith("_")}
    assert len(methods) == len(OPERATIONS)
    assert all(isinstance(one, ClientMethod) for one in methods.values())
