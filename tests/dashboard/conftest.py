"""A browser in which nothing but the server may be reached."""

import os
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import pytest

from tests.running_server import serving

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

ARGUMENTS = (
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--no-first-run",
    "--use-angle=swiftshader",
)


@dataclass
class Visit:
    """One visit to the dashboard."""

    page: "Page"
    url: str
    foreign: list[str] = field(default_factory=list)
    errors: list[str] = field(default_factory=list)

    def screen(self, name: str) -> None:
        """Go to a screen by its link."""
        self.page.get_by_role("link", name=name, exact=True).click()


@pytest.fixture(scope="session")
def browser() -> "Iterator[Browser]":
    path = shutil.which("chromium") or shutil.which("google-chrome")
    if path is None:
        assert "LUMILINE_TEST_REQUIRE_BROWSER" not in os.environ
        pytest.skip("no Chromium on this machine")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=list(ARGUMENTS))
        yield browser
        browser.close()
