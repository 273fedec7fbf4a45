"""What goes wrong on a screen is said there, in words, and nothing else of the page suffers."""

from typing import TYPE_CHECKING

import pytest

from tests.dashboard.conftest import Visit

if TYPE_CHECKING:
    from playwright.sync_api import Route

pytestmark = pytest.mark.slow


def test_fault_of_one_screen_leaves_the_others(visit: Visit):
    page = visit.page
    recordings = "**/api/v1/recordings?*"
    page.route(recordings, lambda route: route.fulfill(json={"items": [None]}))
    visit.screen("Recordings")
    page.get_by_text('The screen "Recordings" has a fault').wait_for()
    assert len(visit.errors) == 1, "it must stay an uncaught error of the page"
    visit.errors.clear()
    visit.screen("Health")
    page.get_by_role("heading", name="Devices and links").wait_for()
    visit.screen("Recordings")
    page.get_by_text('The screen "Recordings" has a fault').wait_for()
    visit.errors.clear()
    page.unroute(recordings)
    page.get_by_role("button", name="Open it again").click()
    page.get_by_role("button", name="Record: Simulated").wait_for()


def test_wrong_marker_is_named_and_an_unsaved_watch_says_so(visit: Visit):
    page = visit.page

    def refuse(route: "Route") -> None:
        if route.request.method == "PUT":
            route.abort()
        else:
            route.fallback()

    page.route("**/api/v1/devices/sim/watch", refuse)
    visit.screen("Quality")
    checks = page.get_by_role("region", name="Quick checks").first
    checks.get_by_label("Strobed marker").fill("123456")
    checks.get_by_text('"123456" is no marker\'s number').wait_for()
    assert checks.get_by_role("button", name="Measure").is_disabled()
    watch = page.get_by_role("region", name="Watch", exact=True)
    marker = watch.get_by_label("Strobed reference marker")
    marker.fill("1, 2")
    watch.get_by_text('"1, 2" is no marker\'s number').wait_for()
    assert watch.get_by_role("button", name="Save").is_disabled()
    marker.fill("1")
    watch.get_by_role("button", name="Save").click()
    watch.get_by_text("The server does not answer.").wait_for()
