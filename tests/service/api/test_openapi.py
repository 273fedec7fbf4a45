"""The OpenAPI document: complete, and every example in it works as it stands on a new server."""

import json
import re
import time
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

import jsonschema_rs
import numpy as np
import pytest
from fastapi.routing import APIRoute, iter_route_contexts

from hardware.recording.writer import RecordingWriter
from hardware.simulated.driver import SimulatedDriver
from hardware.simulated.scenes import MovingTool, MovingTools
from hardware.simulated.settings import SimulationSettings
from service.api.correction_tables.hdf5_file import write_table
from service.api.correction_tables.table_content import MEDIA_TYPE
from service.api.member_descriptions import MEMBERS
from service.api.openapi import ANSWER_EXAMPLES
from service.api.tools import tip_calibration
from service.application.app import create_app
from service.database.models import ApiKeyRow
from service.settings import Settings
from tests.openapi_document import openapi_document
from tests.service.api.correction_tables.tables import content as content_of_table
from tests.service.api.quality.batches import strobed_batch
from tests.service.api.tools.batches import pivoting, resting, spinning, tool_batch
from tests.service.fake_pipeline import FakePipeline, TestClient

# Strobed markers of the tool that an example captures.
CLAMP = {
    4: np.array([0.0, 0.0, 1500.0]),
    5: np.array([90.0, 0.0, 1500.0]),
    6: np.array([0.0, 50.0, 1500.0]),
}
METHODS = ("post", "put", "get", "patch", "delete")
# Making comes first, then reading and changing; what ends something comes last.
LAST = ("delete-", "retire-", "roll-back-", "stop-")


@dataclass(frozen=True)
class Example:
    """One request: an example of the body with an example of each path parameter."""

    operation: str
    method: str
    path: str
    body: Any = None


def operations(found: dict[str, Any]) -> Iterator[tuple[str, str, dict[str, Any]]]:
    for path, item in found["paths"].items():
        for method, operation in item.items():
            yield path, method, operation


def values(examples: dict[str, Any]) -> list[Any]:
    return [example["value"] for example in examples.values()]


def examples(found: dict[str, Any]) -> list[Example]:
    requests = []
    for path, method, operation in operations(found):
        paths = [path]
        for parameter in operation.get("parameters", []):
            if parameter["in"] == "path":
                given = values(parameter["examples"])
                name = f"{{{parameter['name']}}}"
                paths = [one.replace(name, value) for one in paths for value in given]
        content = operation.get("requestBody", {}).get("content", {})
        if content and "application/json" not in content:
            continue  # a file, which no example holds: see prepare()
        bodies = values(content["application/json"]["examples"]) if content else [None]
        requests += [
            Example(operation["operationId"], method, one, body) for one in paths for body in bodies
        ]
    return sorted(
        requests, key=lambda one: (one.operation.startswith(LAST), METHODS.index(one.method))
    )


def prepare(client: Any) -> None:
    """Upload the tables that examples of paths name: on a server they come from mapping runs."""
    nominal = client.get("/api/v1/calibrations/sim-nominal").json()
    for name in ("sim-map", "sim-map-spare"):
        sent = client.post(
            f"/api/v1/correction-tables?id={name}",
            content=write_table(content_of_table(nominal["content_hash"])),
            headers={"content-type": MEDIA_TYPE},
        )
        assert sent.status_code == 201, sent.text
    now = datetime.now(UTC)
    with client.app.state.database.write() as session:  # a key's id is the server's choice
        session.add(
            ApiKeyRow(
                id="examplekey00",
                name="example",
                digest="0" * 64,
                scopes=[],
                created_by="local",
                created_at=now,
            )
        )
    planned = {"kind": "profile", "profile_id": "bar"}
    new = {"id": "planned", "title": "Planned", "source": planned}
    client.post("/api/v1/devices", json=new).raise_for_status()


def wait_for_run(client: Any, run_id: str) -> None:
    end = time.monotonic() + 60.0
    while client.get(f"/api/v1/runs/{run_id}").json()["state"] in ("queued", "running"):
        assert time.monotonic() < end, run_id
        time.sleep(0.05)


def answers_to_examples(
    settings: Settings, patch: pytest.MonkeyPatch
) -> Iterator[tuple[Example, Any]]:
    """Yield each example of the contract and the answer of a new server to it."""
    live = FakePipeline()
    shown = MovingTools((MovingTool(((0.0, 0.0, 0.0),) * 4), MovingTool(((0.0, 0.0, 0.0),) * 3)))
    live.records = SimulatedDriver("sim", SimulationSettings(scene=shown)).description
    live.batches = [
        strobed_batch(range(20)),
        tool_batch([pivoting("pointer", 60), spinning("clamp", 60)], CLAMP),
        tool_batch([resting("pointer", 700, first=1000)]),
    ]
    # Poses are collected for as long as the example says, or until there are enough.
    patch.setattr(tip_calibration, "MAX_COLLECTED", 60)
    with TestClient(create_app(settings, live)) as client:
        served = client.get("/openapi.json").json()
        prepare(client)
        driver = SimulatedDriver("sim", SimulationSettings(duration_s=0.004, realtime=False))
        driver.open()
        with RecordingWriter(settings.folders.recordings / "earlier.h5", live.records) as earlier:
            for frame in driver.frames():
                earlier.append(frame)
        settings.folders.exports.mkdir()
        (settings.folders.exports / "walk.csv").write_text("made before")
        requests = examples(served)
        assert {one.operation for one in requests} == {
            operation["operationId"]
            for _, _, operation in operations(served)
            if operation["operationId"] != "upload-correction-table"
        }
        for one in requests:
            if one.operation == "delete-recording":
                wait_for_run(client, "earlier-export")  # which reads it
            given = {} if one.body is None else {"json": one.body}
            yield one, client.request(one.method, one.path, **given)


@pytest.mark.slow
def test_every_example_works_on_a_new_server(
    sqlite_settings: Settings, monkeypatch: pytest.MonkeyPatch
):
    for one, answer in answers_to_examples(sqlite_settings, monkeypatch):
        assert answer.is_success, (one.operation, one.path, answer.text)


def test_every_operation_has_a_summary_of_its_own():
    """Where a route has none, the document has one all the same: its function's name."""
    routes = {
        context.route.operation_id: context.route.summary
        for context in iter_route_contexts(create_app(Settings()).routes)
        if isinstance(context.route, APIRoute) and context.route.include_in_schema
    }
    assert set(routes) == {found["operationId"] for *_, found in operations(openapi_document())}
    assert [name for name, summary in routes.items() if not (summary or "").strip()] == []


def test_every_operation_is_described():
    found = openapi_document()
    tags = {tag["name"] for tag in found["tags"]}
    ids = [operation["operationId"] for _, _, operation in operations(found)]
    assert len(ids) == len(set(ids))
    for path, method, operation in operations(found):
        assert operation["summary"].strip(), path
        assert operation["description"], path
        assert set(operation["tags"]) <= tags
        for parameter in operation.get("parameters", []):
            assert parameter.get("description") or parameter["in"] == "query", (path, parameter)
            if parameter["in"] == "path":
                assert parameter["examples"]
        if method in ("post", "patch") and "requestBody" in operation:
            content = operation["requestBody"]["content"]
            if "application/json" in content:
                assert content["application/json"]["examples"]
            else:
                assert operation["operationId"] == "upload-correction-table"


def test_every_error_response_is_a_problem_document():
    for path, method, operation in operations(openapi_document()):
        errors = {
            status: response
            for status, response in operation["responses"].items()
            if int(status) >= 400
        }
        assert "500" in errors
        for status, response in errors.items():
            assert set(response["content"]) == {"application/problem+json"}, (path, method, status)
            schema = response["content"]["application/problem+json"]["schema"]
            assert schema == {"$ref": "#/components/schemas/Problem"}


def test_no_reference_dangles():
    found = openapi_document()
    schemas = found["components"]["schemas"]

    def references(node: Any) -> Iterator[str]:
        if isinstance(node, dict):
            if isinstance(node.get("$ref"), str):
                yield node["$ref"]
            for value in node.values():
                yield from references(value)
        elif isinstance(node, list):
            for value in node:
                yield from references(value)

    for reference in set(references(found)):
        assert reference.rpartition("/")[2] in schemas
    assert "HTTPValidationError" not in schemas


@pytest.mark.parametrize(("path", "script"), [("/docs", "swagger"), ("/redoc", "redoc")])
def test_there_is_a_page_to_read_it(sqlite_client: Any, path: str, script: str):
    start = f"/docs/assets/{script}-start.js"
    assert start in sqlite_client.get(path).text
    assert "/openapi.json" in sqlite_client.get(start).text


def test_every_member_is_described():
    found = openapi_document()["components"]["schemas"]
    missing = [
        f"{name}.{member}"
        for name, schema in found.items()
        for member, value in schema.get("properties", {}).items()
        if not value.get("description", "").strip()
    ]
    assert missing == [], "describe them at their fields, or in service.api.member_descriptions"
    assert [name for name, schema in found.items() if not schema.get("description")] == []
    python = re.compile(r"\b(Args|Raises|Returns):")
    assert [name for name, one in found.items() if python.search(one["description"])] == []


def test_every_description_of_a_member_is_used():
    names = {
        key
        for name, schema in openapi_document()["components"]["schemas"].items()
        for member in schema.get("properties", {})
        for key in (member, f"{name.rpartition('__')[2]}.{member}")
    }
    assert MEMBERS.keys() - names == set()


def test_every_json_answer_has_an_example_of_its_schema():
    found = openapi_document()
    checked = 0
    for _, _, operation in operations(found):
        name = operation["operationId"]
        for status, response in operation["responses"].items():
            content = response.get("content", {}).get("application/json")
            if not status.startswith("2") or content is None:
                continue
            assert "example" in content, f"{name}: run python -m tests.service.api.record_answers"
            schema = {**content["schema"], "components": found["components"]}
            errors = list(jsonschema_rs.validator_for(schema).iter_errors(content["example"]))
            assert errors == [], (name, "run python -m tests.service.api.record_answers")
            checked += 1
    assert checked > 90
    assert ANSWERS.keys() <= {operation["operationId"] for *_, operation in operations(found)}


ANSWERS = json.loads(ANSWER_EXAMPLES.read_text(encoding="utf-8"))
