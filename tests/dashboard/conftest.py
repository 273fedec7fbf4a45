"""A browser in which nothing but the server may be reached."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import pytest

from tests.running_server import serving

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page, Route


@dataclass
class Visit:
    """A visit to the dashboard, and what went wrong during it."""

    page: "Page"
    url: str
    foreign: list[str] = field(default_factory=list)
    errors: list[str] = field(default_factory=list)

    def screen(self, name: str) -> None:
        """Go to a screen by its link."""
        self.page.get_by_role("link", name=name, exact=True).click()


@pytest.fixture(scope="session")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Base URL of a running service with the simulated device."""
    with serving(tmp_path_factory.mktemp("dashboard")) as url:
        yield url


@contextmanager
def visiting(browser: "Browser", url: str) -> Iterator[Visit]:
    """Open the dashboard of a server; whatever it asks of another origin fails the test."""
    context = browser.new_context(viewport={"width": 1280, "height": 900})
    context.set_default_timeout(270_000)  # the machine may be busy
    visit = Visit(context.new_page(), url)

    def route(route: "Route") -> None:
        if route.request.url.startswith((f"{url}/", "blob:")):
            route.continue_()
        else:
            visit.foreign.append(route.request.url)
            route.abort()

    context.route("**/*", route)
    visit.page.on("pageerror", lambda error: visit.errors.append(str(error)))
    visit.page.on("console", lambda message: _keep_policy_violation(visit, message.text))
    visit.page.goto(f"{url}/")
    try:
        yield visit
    finally:
        context.close()
    assert not visit.foreign
    assert not visit.errors


def _keep_policy_violation(visit: Visit, text: str) -> None:
    if "Content Security Policy" in text:
        visit.errors.append(text)


@pytest.fixture
def visit(browser: "Browser", server: str) -> Iterator[Visit]:
    """The dashboard of the server with the simulated device."""
    with visiting(browser, server) as visit:
        yield visit
