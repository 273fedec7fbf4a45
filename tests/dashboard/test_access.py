"""The dashboard of a server that wants a key, and of one that ends and comes back."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import httpx
import pytest

from service.cli.service_process import RunningService, service_process
from service.database.engine import Database
from service.principal import SCOPES
from service.security import store
from service.settings import Settings
from tests.dashboard.conftest import Visit, visiting

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def guarded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[RunningService, str]]:
    """A server that also wants a key of programs on its own machine, and an administrator's key."""
    folder = tmp_path_factory.mktemp("guarded")
    with service_process(folder, {"authentication": "required"}, quiet=True) as service:
        database = Database(Settings(data_dir=folder).effective_database_url)
        with database.write() as session:
            _, key = store.add_key(session, "administrator", SCOPES)
        database.close()
        yield service, key.text


def new_key(service: RunningService, administrator: str, scopes: list[str]) -> str:
    answer = httpx.post(
        f"{service.url}/api/v1/keys",
        json={"name": "viewer", "scopes": scopes},
        headers={"Authorization": f"Bearer {administrator}"},
    )
    key: str = answer.raise_for_status().json()["key"]
    return key


def log_in(visit: Visit, key: str) -> None:
    visit.page.get_by_label("Key").fill(key)
    visit.page.get_by_role("button", name="Open").click()


def test_viewer_is_asked_for_a_key_and_may_not_activate(
    browser: "Browser", guarded: tuple[RunningService, str]
):
    service, administrator = guarded
    key = new_key(service, administrator, ["read:stream", "read:calibration"])
    with visiting(browser, service.url) as visit:
        log_in(visit, "lumi_none_wrong")
        visit.page.get_by_role("alert").wait_for()
        log_in(visit, key)
        visit.page.get_by_role("combobox").first.wait_for()
        assert key not in visit.page.url
        visit.screen("Calibrate")
        roll_back = visit.page.get_by_role("button", name="Roll back")
        roll_back.wait_for()
        assert roll_back.is_disabled()
        lacking = "Your key does not allow this: it lacks the scope activate:calibrations."
        assert lacking in visit.page.content()
        # A plan of what is stored may be seen; others may not be made.
        visit.screen("Plan")
        visit.page.get_by_role("heading", name="What it would reach").wait_for()
        assert visit.page.get_by_label("Baseline").is_disabled()
        assert "it lacks the scope admin:devices." in visit.page.content()
        visit.page.reload()
        visit.page.get_by_role("combobox").first.wait_for()  # kept for the session
    with visiting(browser, service.url) as visit:
        visit.page.get_by_label("Key").wait_for()  # and no longer


def test_page_says_that_the_server_is_gone_and_lives_again_when_it_is_back(
    browser: "Browser", tmp_path: Path
):
    with service_process(tmp_path, quiet=True) as service:
        port = service.url.rpartition(":")[2]
        context = visiting(browser, service.url)
        visit = context.__enter__()
        points = visit.page.get_by_role("region", name="Points").locator("tbody tr")
        points.first.wait_for()
    try:
        visit.page.get_by_text("Connection lost. What is shown is old.").first.wait_for()
        with service_process(tmp_path, quiet=True, port=int(port)):
            visit.page.get_by_text("Connection lost").first.wait_for(state="detached")
            points.first.wait_for()
    finally:
        context.__exit__(None, None, None)
