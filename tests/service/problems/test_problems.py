"""Problem documents: one for everything that can go wrong, none with secrets in it."""

import json
import logging
import re
from typing import Any

import pytest
from sqlalchemy.exc import OperationalError

from service.application.app import create_app
from service.problems.bounds import display_value, json_safe
from service.problems.catalogue import PROBLEM_TYPES
from service.settings import Settings
from tests.openapi_document import openapi_document
from tests.service.fake_pipeline import FakePipeline, TestClient


@pytest.mark.slow
def test_every_problem_type_has_a_page_for_programs_and_for_people(sqlite_client: Any):
    listed = sqlite_client.get("/problems", params={"limit": 200}).json()["items"]
    assert {item["code"] for item in listed} == set(PROBLEM_TYPES)
    assert {"coplanar-points", "too-few-points", "unknown-device"} <= set(PROBLEM_TYPES)
    for item in listed:
        assert sqlite_client.get(item["type"]).json() == item
        assert 400 <= item["status"] < 600
        page = sqlite_client.get(item["type"], headers={"accept": "text/html,*/*"})
        assert page.headers["content-type"] == "text/html; charset=utf-8"
        assert f"<h1>{item['title']}</h1>" in page.text


@pytest.mark.parametrize(
    ("method", "path", "allowed"),
    [
        ("DELETE", "/api/v1/devices", "GET, HEAD, POST"),
        ("POST", "/api/v1/devices/sim", "DELETE, GET, HEAD, PATCH"),
        ("GET", "/api/v1/devices/sim/start", "POST"),
        ("POST", "/problems/not-found", "GET, HEAD"),
        ("HEAD", "/api/v1/devices/sim/start", "POST"),
    ],
)
def test_a_wrong_method_says_which_are_right(
    sqlite_client: Any, method: str, path: str, allowed: str
):
    answer = sqlite_client.request(method, path)
    assert answer.status_code == 405
    assert answer.headers["allow"] == allowed
    assert answer.headers["content-type"] == "application/problem+json"


@pytest.mark.slow
def test_a_wrong_method_is_told_those_of_the_contract_without_making_it(sqlite_client: Any):
    """For every path, names in the place of its parameters; the document takes seconds to make.

    A path may be of two templates: /runs/calibration is where runs are posted, and a run's name.
    """
    paths = openapi_document()["paths"]
    templates = {re.compile(re.sub(r"\{[^}]*\}", "[^/]+", path)): paths[path] for path in paths}
    for path in paths:
        named = re.sub(r"\{[^}]*\}", "name", path)
        allowed = {
            method.upper()
            for template, item in templates.items()
            if template.fullmatch(named)
            for method in item
        }
        if "GET" in allowed:
            allowed.add("HEAD")
        answer = sqlite_client.request("PROPFIND", named)
        assert answer.status_code == 405, path
        assert answer.headers["allow"] == ", ".join(sorted(allowed)), path
    assert sqlite_client.app.openapi_schema is None


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_values_that_json_cannot_hold_are_shown_as_text(value: float):
    text = json.dumps(json_safe({"a": [value], "b": (1, None, b"\xff", object)}), allow_nan=False)
    assert display_value(value) in text


def test_a_long_value_is_cut():
    assert len(display_value("x" * 10_000)) == 200


def test_an_unexpected_error_gives_a_reference_and_no_secret(
    sqlite_client: Any, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    def broken(*_: Any) -> None:
        raise RuntimeError("password=hunter2")

    monkeypatch.setattr(sqlite_client.app.state.live, "status", broken)
    with caplog.at_level(logging.ERROR):
        answer = sqlite_client.get("/api/v1/devices/sim/state")
    assert answer.status_code == 500
    assert answer.headers["content-type"] == "application/problem+json"
    assert answer.json()["type"] == "/problems/internal-error"
    assert "hunter2" not in answer.text
    reference = answer.json()["detail"].split()[-1]
    logged = next(record for record in caplog.records if reference in record.getMessage())
    assert logged.exc_info is not None
    assert "hunter2" in str(logged.exc_info[1])


def test_a_body_without_declared_length_is_limited_too(tmp_path: Any):
    settings = Settings(data_dir=tmp_path, body_limit_bytes=2000)

    def parts() -> Any:
        for _ in range(30):
            yield b" " * 100

    with TestClient(create_app(settings, FakePipeline())) as client:
        answer = client.post(
            "/api/v1/devices", content=parts(), headers={"content-type": "application/json"}
        )
        assert "content-length" not in answer.request.headers
    assert answer.status_code == 413
    assert answer.headers["content-type"] == "application/problem+json"
    assert answer.json()["type"] == "/problems/body-too-large"
    assert "2000 bytes" in answer.json()["detail"]


@pytest.mark.slow
def test_ready_only_with_database_and_live_pipeline(
    sqlite_client: Any, live: FakePipeline, monkeypatch: pytest.MonkeyPatch
):
    assert sqlite_client.get("/readyz").json()["status"] == "ok"
    live.answers = False
    answer = sqlite_client.get("/readyz")
    assert (answer.status_code, answer.json()["context"]) == (503, {"part": "live"})
    live.answers = True

    def refuse(_: Any) -> None:
        raise OperationalError("SELECT 1", {}, Exception("postgresql://user:hunter2@host"))

    monkeypatch.setattr("service.application.server.revision_of", refuse)
    answer = sqlite_client.get("/readyz")
    assert (answer.status_code, answer.json()["context"]) == (503, {"part": "database"})
    assert "hunter2" not in answer.text
    assert sqlite_client.get("/healthz").json() == {"status": "ok"}


@pytest.mark.parametrize(("literal", "status"), [("8.0", 200), ("1e1", 200), ("8.5", 422)])
def test_a_whole_number_may_be_written_with_a_point(sqlite_client: Any, literal: str, status: int):
    # JSON schema, and so the contract, takes 8.0 for an integer.
    text = '{"source": {"kind": "simulated", "settings": {"bits": HERE}}}'.replace("HERE", literal)
    answer = sqlite_client.patch(
        "/api/v1/devices/sim", content=text, headers={"content-type": "application/json"}
    )
    assert answer.status_code == status, answer.text
    if status == 200:
        assert answer.json()["source"]["settings"]["bits"] == float(literal)
