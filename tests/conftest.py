"""For all tests: how examples are generated, and no certificates.

``make test`` generates the same few examples each time, ``make test-slow`` many new ones, for the
same tests: LUMILINE_TEST_EXAMPLES is "deterministic" (the default) or "random". Neither keeps
examples from one run for the next; a failure of random ones prints what reproduces it. Examples
have no time limit of their own, as machines may be busy.
"""

import gc
import os
import shutil
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from hypothesis import settings

if TYPE_CHECKING:
    from collections.abc import Iterator

    from playwright.sync_api import Browser

# Every httpx client reads the certificates of all authorities, 36 ms, whatever it then talks to:
# tests talk to servers of their own, and here are no certificates.
os.environ["SSL_CERT_DIR"] = str(Path(__file__).parent)
os.environ.pop("SSL_CERT_FILE", None)

settings.register_profile(
    "deterministic", deadline=None, derandomize=True, database=None, max_examples=30
)
settings.register_profile(
    "random", deadline=None, derandomize=False, database=None, print_blob=True
)
settings.load_profile(os.environ.get("LUMILINE_TEST_EXAMPLES", "deterministic"))

# What is imported and collected stays until the end: to look through it for garbage again and again
# takes a quarter of the time of the collection.
gc.disable()


def pytest_collection_finish() -> None:
    """Collect garbage from now on, but not among what is there already."""
    gc.freeze()
    gc.enable()


BROWSER_ARGUMENTS = (
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--no-first-run",
    "--use-angle=swiftshader",
)


@pytest.fixture
def browser() -> "Iterator[Browser]":
    """A Chromium of this machine, for one test: Playwright keeps an event loop while it is open."""
    path = shutil.which("chromium") or shutil.which("google-chrome")
    if path is None:
        assert "LUMILINE_TEST_REQUIRE_BROWSER" not in os.environ
        pytest.skip("no Chromium on this machine")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=list(BROWSER_ARGUMENTS))
        yield browser
        browser.close()
