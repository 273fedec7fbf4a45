"""Bounds of error documents, whatever a body holds."""

import json
from collections.abc import Iterator
from typing import Any

import pytest
from pydantic import BaseModel, TypeAdapter

from service.api.base_models import RequestModel
from service.api.calibrations.schema import MAX_POINTS
from service.application.app import create_app
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


def test_long_lists_of_request_bodies_end_at_the_first_wrong_item():
    """A list of more than 256 items, or without a bound, whose errors nobody would read."""
    found = []
    for model in request_models(RequestModel):
        schema = TypeAdapter(model).core_schema
        found += [(model.__name__, one) for one in unbounded(schema) if not one.get("fail_fast")]
    assert not [f"{name}: {one.get('metadata')}" for name, one in found]
    assert MAX_POINTS > 100


def request_models(base: type[BaseModel]) -> Iterator[type[BaseModel]]:
    for model in base.__subclasses__():
        yield model
        yield from request_models(model)


def unbounded(schema: Any) -> Iterator[dict[str, Any]]:
    if isinstance(schema, dict):
        inner = schema.get("items_schema") or schema.get("values_schema") or {"type": "any"}
        long = schema.get("type") in ("list", "dict") and schema.get("max_length", 1e9) > 256
        if long and inner["type"] != "any":
            yield schema
        for value in schema.values():
            yield from unbounded(value)
    elif isinstance(schema, list | tuple):
        for value in schema:
            yield from unbounded(value)
