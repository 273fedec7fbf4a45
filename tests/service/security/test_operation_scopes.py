"""The table of access: complete, as documented, and in the contract."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from fastapi import FastAPI

from service.application.app import create_app
from service.principal import SCOPE_MEANINGS, SCOPES
from service.security import guard
from service.security.guard import Guard, check_complete
from service.security.operation_scopes import OPERATION_SCOPES
from service.settings import Settings
from tests.openapi_document import openapi_document
from tests.service.fake_pipeline import FakePipeline, TestClient
from tests.service.security.conftest import Secured
from tests.service.security.documented_scopes import documented, documented_tasks


def test_the_guide_says_what_the_code_does() -> None:
    rows = documented()
    assert {row.operation: row.scope for row in rows} == OPERATION_SCOPES
    assert len(rows) == len(OPERATION_SCOPES)


@pytest.mark.slow
def test_the_tables_of_the_guide_are_made_from_the_code() -> None:
    root = Path(__file__).parents[3]
    command = [sys.executable, root / "docs" / "generators" / "access.py", "--check"]
    status = subprocess.run(command, cwd=root, check=False).returncode
    assert status == 0, "run `python docs/generators/access.py`"


def test_the_guide_proposes_scopes_that_there_are() -> None:
    tasks = documented_tasks()
    assert len(tasks) == 5
    assert tasks["console of a treatment room"] == {"read:stream", "operate:holds"}
    assert frozenset[str]().union(*tasks.values()) <= set(SCOPES)


def test_the_guide_names_each_request_as_the_contract_does() -> None:
    asked = {row.operation: f"{row.method} {row.path}" for row in documented()}
    paths = openapi_document()["paths"]
    for path, item in paths.items():
        for method, operation in item.items():
            assert asked[operation["operationId"]] == f"{method.upper()} {path}"


def test_the_contract_shows_the_scope_of_every_operation() -> None:
    document = openapi_document()
    assert set(document["components"]["securitySchemes"]) == {"key"}
    for scope, meaning in SCOPE_MEANINGS.items():
        assert (
            f"`{scope}`: {meaning}"
            in document["components"]["securitySchemes"]["key"]["description"]
        )
    for item in document["paths"].values():
        for operation in item.values():
            needed = OPERATION_SCOPES[operation["operationId"]]
            if needed == "public":
                assert operation["security"] == []
                assert "401" not in operation["responses"]
            else:
                assert operation["security"] == [{"key": [needed]}]
                assert f"`{needed}`" in operation["description"]
                assert {"401", "403", "429"} <= operation["responses"].keys()


def test_a_route_without_an_entry_keeps_the_server_from_starting(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    less = {name: scope for name, scope in OPERATION_SCOPES.items() if name != "stop-device"}
    monkeypatch.setattr(guard, "OPERATION_SCOPES", less)
    with pytest.raises(ValueError, match='"stop-device" is not in'):
        create_app(Settings())


def test_an_entry_without_a_route_does_so_too(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(guard, "OPERATION_SCOPES", {**OPERATION_SCOPES, "gone": "public"})
    with pytest.raises(ValueError, match='"gone", which no route has'):
        create_app(Settings())


def test_a_websocket_without_an_entry_is_found(secured: Secured) -> None:
    app = FastAPI(docs_url=None, redoc_url=None)

    async def unknown(websocket: Any) -> None: ...

    app.add_api_websocket_route("/unknown", unknown)
    with pytest.raises(ValueError, match='"unknown" is not in'):
        check_complete(app.routes)


def test_a_route_that_the_guard_did_not_let_in_does_not_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def pass_on(guard: Any, scope: Any, receive: Any, send: Any) -> None:
        await guard._app(scope, receive, send)

    monkeypatch.setattr(Guard, "__call__", pass_on)
    app = create_app(Settings(data_dir=tmp_path), FakePipeline())
    with TestClient(app, raise_server_exceptions=False) as client:
        for path in ("/api/v1/devices", "/healthz"):
            answer = client.get(path)
            assert (answer.status_code, answer.json()["type"]) == (500, "/problems/internal-error")
        with pytest.raises(RuntimeError, match='did not let operation "stream" in'):
            client.websocket_connect("/api/v1/stream?device_id=sim").__enter__()


def test_every_scope_is_needed_by_something() -> None:
    assert set(SCOPES) == set(OPERATION_SCOPES.values()) - {"public"}
