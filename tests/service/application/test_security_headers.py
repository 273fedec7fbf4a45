"""Security headers of all answers; documentation pages without anything from elsewhere."""

import re
from typing import TYPE_CHECKING, Any

import httpx
import pytest
from fastapi.routing import iter_route_contexts

from service.application.app import create_app
from service.settings import Settings
from tests.service.fake_pipeline import FakePipeline, TestClient

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Request

HEADERS = {
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    "referrer-policy": "no-referrer",
}


def check_headers(answer: httpx.Response) -> str:
    assert {name: answer.headers.get(name) for name in HEADERS} == HEADERS, answer.request.url
    policies = answer.headers.get_list("content-security-policy")
    assert len(policies) == 1, answer.request.url
    directives = [part.split() for part in policies[0].split(";")]
    scripts = [sources for name, *sources in directives if name in ("default-src", "script-src")]
    assert all(set(sources) <= {"'none'", "'self'"} for sources in scripts), policies[0]
    assert "frame-ancestors 'none'" in policies[0]
    return policies[0]


def test_headers_are_in_the_answers_of_all_routes_whatever_the_outcome(sqlite_settings: Settings):
    app = create_app(sqlite_settings, FakePipeline())
    statuses = set()
    with TestClient(app, raise_server_exceptions=False) as client:
        routes = [
            (method, re.sub(r"{[^}]*}", "none", str(route.path)))
            for route in iter_route_contexts(app.routes)
            for method in sorted(getattr(route, "methods", None) or ())
        ]
        assert len(routes) > 100
        for method, path in [*routes, ("GET", "/no/such/path"), ("PUT", "/healthz")]:
            answer = client.request(method, path, content=b"")
            check_headers(answer)
            statuses.add(answer.status_code)
    assert {200, 404, 405, 415, 422} & statuses >= {200, 404, 405}


def test_headers_are_in_the_answer_to_an_unexpected_error(
    sqlite_settings: Settings, monkeypatch: pytest.MonkeyPatch
):
    def broken(*_: Any) -> None:
        raise RuntimeError("broken")

    monkeypatch.setattr("service.application.server.check_ready", broken)
    app = create_app(sqlite_settings, FakePipeline())
    with TestClient(app, raise_server_exceptions=False) as client:
        answer = client.get("/readyz")
        assert answer.status_code == 500
        check_headers(answer)


@pytest.mark.parametrize("path", ["/docs", "/redoc"])
def test_what_the_pages_load_is_served_here(sqlite_client: Any, path: str):
    page = sqlite_client.get(path)
    check_headers(page)
    assert "<script>" not in page.text
    loaded = re.findall(r'(?:src|href)="([^"]+)"', page.text)
    assert loaded
    for address in loaded:
        assert address.startswith("/docs/assets/")
        assert sqlite_client.get(address).status_code == 200
    assert sqlite_client.get("/docs/assets/..%2f__init__.py").status_code in (404, 422)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("path", "shown"), [("/docs", "Calibrates linear (1D)"), ("/redoc", "Calibrates linear (1D)")]
)
def test_pages_work_in_a_browser_without_another_origin(
    browser: "Browser", server: str, path: str, shown: str
):
    page = browser.new_page()
    requested: list[Request] = []
    problems: list[str] = []
    page.on("request", lambda request: requested.append(request))
    page.on("pageerror", lambda error: problems.append(str(error)))
    page.goto(f"{server}{path}")
    page.get_by_text(shown).first.wait_for(timeout=60_000)
    page.wait_for_load_state("networkidle")
    foreign = {
        request.url: request.failure
        for request in requested
        if not request.url.startswith((server, "data:", "blob:"))
    }
    page.close()
    # ReDoc would load its maker's logo; the policy does not let the request out.
    assert set(foreign) <= {"https://cdn.redoc.ly/redoc/logo-mini.svg"}
    assert set(foreign.values()) <= {"csp"}
    assert not problems
