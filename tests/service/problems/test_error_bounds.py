"""Bounds of error documents, whatever a body holds."""

import itertools
import json
from collections.abc import Iterator
from typing import Any

import pytest
from fastapi.routing import iter_route_contexts
from pydantic import TypeAdapter

from compute.errors import InvalidParameter
from service.api.beam_holds.schema import NewBeamHold
from service.api.devices.schema import NewDevice
from service.api.json_body import read_json_body
from service.api.radiometric_calibrations.schema import NewRadiometricCalibration
from service.api.security.schema import NewApiKey
from service.api.tools.schema import NewTool
from service.api.webhooks.schema import NewWebhook
from service.application.app import create_app
from service.problems.bounds import display_value, json_safe
from service.problems.catalogue import PROBLEM_TYPES, FieldError
from service.problems.field_errors import FieldErrors
from service.problems.handlers import error_response, problem_response
from service.settings import Settings
from tests.service.fake_pipeline import FakePipeline, TestClient

MAX_BYTES = 64 * 1024


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TestClient]:
    folder = tmp_path_factory.mktemp("server")
    with TestClient(create_app(Settings(data_dir=folder), FakePipeline())) as running:
        yield running


POINT = {"name": "P", "position_mm": [1.0, 2.0, 3.0], "readings": {"vertical": "wrong"}}
NAMES = [f"s{number:03d}" for number in range(500)]

BODIES = {
    "wrong readings in many points": (
        "calibrations", {"device_id": "sim", "points": [POINT] * 9000},
    ),
    "empty points": ("calibrations", {"device_id": "sim", "points": [{}] * 9000}),
    "empty points of a reconstruction": (
        "reconstructions", {"device_id": "sim", "points": [{}] * 9000},
    ),
    "wrong readings in one point": (
        "calibrations",
        {"device_id": "sim", "points": [{**POINT, "readings": dict.fromkeys(NAMES, "x")}]},
    ),
    "unknown members": ("devices", dict.fromkeys(NAMES, 1)),
    "unknown members with long names": ("devices", {name * 100: "x" * 900 for name in NAMES}),
    "unknown members of a point": (
        "calibrations", {"device_id": "sim", "points": [dict.fromkeys(NAMES, 1)] * 100},
    ),
    "a run's points": ("runs/calibration", {"device_id": "sim", "points": [{}] * 9000}),
    "targets": ("captures", {"device_id": "sim", "targets": [{}] * 9000}),
    "scans of texts": ("line-scans", {"method": "fit", "scans": [["x"] * 5000] * 8}),
    "a surface's vertices": (
        "registrations",
        {"kind": "surface", "surface": {"kind": "mesh", "vertices_mm": [["x"]] * 9000}},
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", BODIES)
def test_an_error_document_is_short_whatever_the_body_holds(client: TestClient, name: str):
    path, body = BODIES[name]
    answer = client.post(f"/api/v1/{path}", content=json.dumps(body), headers=JSON)
    assert answer.status_code in (413, 422)
    assert len(answer.content) <= MAX_BYTES
    assert 1 <= len(answer.json().get("errors", [0])) <= 50
    assert answer.json()["detail"]


JSON = {"Content-Type": "application/json"}


def test_an_object_of_very_many_members_is_refused_with_its_number(client: TestClient):
    body = json.dumps({f"m{number}": 1 for number in range(5_000)})
    answer = client.post("/api/v1/devices", content=body, headers=JSON)
    assert answer.status_code == 413
    assert "5000 members" in answer.json()["detail"]


def test_errors_that_are_left_out_are_counted(client: TestClient):
    answer = client.post("/api/v1/devices", json=dict.fromkeys(NAMES[:60], 1))
    assert len(answer.json()["errors"]) == 50
    lacking = sum("required" in one["message"] for one in answer.json()["errors"])
    assert f"and {60 + lacking - 3} more" in answer.json()["detail"]  # it has three itself


def test_lists_of_all_request_bodies_end_at_the_first_wrong_item(client: TestClient):
    """Also those of models of other packages, such as the scenes of a simulated device."""
    found = {}
    for route in iter_route_contexts(client.app.routes):
        body = getattr(route.original_route, "body_field", None)
        if body is not None:
            schema = TypeAdapter(body.field_info.annotation).core_schema
            found[f"{route.methods} {route.path_format}"] = list(patient_lists(schema, ()))
    assert len(found) > 30
    assert {path: lists for path, lists in found.items() if lists} == {}


def patient_lists(schema: Any, path: tuple[Any, ...]) -> Iterator[tuple[Any, ...]]:
    """Yield the paths, within a core schema, of lists of any length that collect all errors."""
    if isinstance(schema, dict):
        kind = schema.get("type")
        of_any_length = kind in ("list", "set", "frozenset", "generator") or (
            kind == "tuple" and schema.get("variadic_item_index") is not None
        )
        any_items = schema.get("items_schema", {"type": "any"}) == {"type": "any"}
        if of_any_length and not any_items and not schema.get("fail_fast"):
            yield path
        for key, value in schema.items():
            yield from patient_lists(value, (*path, key))
    elif isinstance(schema, list | tuple):
        for value in schema:
            yield from patient_lists(value, path)


ITEMS = ",".join(["[]"] * 5_000)
SCENE = '{"kind": "still-points", "points_mm": [%s]}'
LISTS = {
    "points of a scene": (
        NewDevice,
        '{"source": {"kind": "simulated", "settings": {"scene": ' + SCENE % ITEMS + "}}}",
    ),
    "markers of a hold": (
        NewBeamHold, '{"reference": {"positions_mm": [' + ITEMS + "]}, \"watch\": {}}",
    ),
    "light of a calibration": (
        NewRadiometricCalibration,
        '{"source": {"kind": "scans", "relative_light": [' + ITEMS + "]}}",
    ),
    "markers of a tool": (NewTool, '{"markers_mm": [' + ITEMS + "]}"),
    "scopes of a key": (NewApiKey, '{"scopes": [' + ITEMS + "]}"),
    "types of events": (NewWebhook, '{"event_types": [' + ITEMS + "]}"),
}  # fmt: skip


@pytest.mark.parametrize("name", LISTS)
def test_body_of_many_wrong_items_has_few_errors(name: str):
    model, body = LISTS[name]
    found = read_json_body(model, "application/json", body.encode(), 2**20)
    assert isinstance(found, FieldErrors)
    assert found.count <= 12


class Endless(list[int]):
    """A list that would never end."""

    def __iter__(self) -> Iterator[int]:
        return itertools.count()


def test_of_a_long_value_no_more_is_written_than_is_shown():
    text = display_value({"a": Endless(), "b": 1})
    assert text.startswith('{"a": [0, 1, 2, ')
    assert text.endswith("...")
    assert len(text) == 200


@pytest.mark.parametrize(
    "value", [{"a": [1, 2.5, None, True], "b": ("x", b"y")}, [], {}, "a\n\u20ac"]
)
def test_a_short_value_is_shown_as_json(value: Any):
    assert display_value(value) == json.dumps(json_safe(value))


@pytest.mark.parametrize("text", ["a", "\u20ac", "\U0001f600", '"', "\ud800"])
def test_problem_document_is_short_whatever_an_error_holds(text: str):
    errors = [
        FieldError(location=["body", *[text * 100] * 20], message=text * 500, input=text * 200)
    ] * 500
    context = {
        "text": text * 100_000,
        "texts": [text * 100_000] * 100,
        "lists": [[text * 50] * 1_000] * 1_000,
        "object": dict.fromkeys(map(str, range(10_000)), text),
        "number": 5,
    }
    answer = problem_response(
        PROBLEM_TYPES["invalid-parameter"],
        text * 100_000,
        "/" + text * 60_000,
        errors=errors,
        context=context,
    )
    assert len(answer.body) <= MAX_BYTES
    document = json.loads(answer.body)
    assert 1 <= len(document["errors"]) <= 50
    assert document["context"]["number"] == 5
    assert document["context"]["text"].startswith(text)
    assert document["detail"].endswith("...")


def test_short_error_is_told_as_it_is():
    error = InvalidParameter("x is 3; it must be 2", x=3, all=[1.5, float("nan")], none=None)
    document = json.loads(error_response(error, "/here").body)
    assert document["detail"] == "x is 3; it must be 2"
    assert document["instance"] == "/here"
    assert document["context"] == {"x": 3, "all": [1.5, "NaN"], "none": None}


def test_answer_for_a_long_path_is_short(client: TestClient):
    answer = client.get("/" + "a" * 60_000)
    assert answer.status_code == 404
    assert len(answer.content) <= 8 * 1024
