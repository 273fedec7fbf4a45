"""Bodies of the benchmark of hostile bodies."""

from collections.abc import Iterator

import pytest

from benchmarks.hostile_bodies import INLINE_BYTES, bodies, small_bodies
from service.api import json_body
from service.application.app import create_app
from service.security.operation_scopes import OPERATION_SCOPES
from service.settings import Settings
from tests.openapi_document import openapi_document
from tests.service.fake_pipeline import FakePipeline, TestClient

pytestmark = pytest.mark.slow  # each body is worked out in a process of its own


def test_bodies_are_of_every_scope_by_which_one_is_sent():
    scopes = {
        OPERATION_SCOPES[operation["operationId"]]
        for item in openapi_document()["paths"].values()
        for method, operation in item.items()
        if method == "post" and "requestBody" in operation
    }
    assert {scope for scope, _, _ in bodies().values()} == scopes - {None}


def test_small_bodies_are_as_large_as_those_that_the_event_loop_reads():
    assert INLINE_BYTES == json_body.INLINE_BYTES


def test_paths_of_bodies_take_bodies(client: TestClient):
    """A misspelt path would answer at once, and the benchmark would measure nothing."""
    for name, (_, path, _) in bodies().items():
        answer = client.post(f"/api/v1/{path}", content=b"x")
        assert answer.status_code == 415, name


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TestClient]:
    settings = Settings(data_dir=tmp_path_factory.mktemp("server"))
    with TestClient(create_app(settings, FakePipeline())) as running:
        yield running


@pytest.mark.parametrize("name", small_bodies())
def test_small_hostile_body_is_refused_with_a_short_answer(client: TestClient, name: str):
    _, path, body = small_bodies()[name]
    answer = client.post(
        f"/api/v1/{path}", content=body, headers={"Content-Type": "application/json"}
    )
    assert answer.status_code in (404, 422)
    assert len(answer.content) <= 64 * 1024
    assert len(answer.json().get("errors", [])) <= 50
