"""Connections that break or fall silent, and what the page then shows; focus and copying."""

import re
import time
from typing import TYPE_CHECKING

import httpx
import pytest

from tests.dashboard.conftest import Visit
from tests.dashboard.test_pages import show

if TYPE_CHECKING:
    from playwright.sync_api import Locator, Page, WebSocketRoute

pytestmark = pytest.mark.slow

OLD = "What is shown is old."


def points(page: "Page") -> "Locator":
    return page.get_by_role("region", name="Points").last.locator("tbody tr")


def test_stream_that_falls_silent_says_so_and_is_opened_again(visit: Visit):
    show(visit.url, {"kind": "rotating-bar"})
    page = visit.page
    opened: list[float] = []
    silenced = 0

    def pass_on(socket: "WebSocketRoute") -> None:
        opened.append(time.monotonic())
        server = socket.connect_to_server()
        mine = len(opened)
        server.on_message(lambda one: None if mine <= silenced else socket.send(one))

    page.route_web_socket("**/api/v1/stream*", pass_on)
    page.reload()
    points(page).first.wait_for()
    old = page.get_by_role("alert").filter(has_text=OLD)
    old.wait_for(state="detached")
    silenced = len(opened)
    fell = time.monotonic()
    page.get_by_text(f"The server sends no data. {OLD}").wait_for()
    assert page.locator("canvas.stale").count() == 1
    old.wait_for(state="detached")
    assert len(opened) > silenced
    assert opened[silenced] - fell > 4
    points(page).first.wait_for()


def test_page_shown_again_is_old_until_the_server_greets(visit: Visit):
    show(visit.url, {"kind": "rotating-bar"})
    page = visit.page
    greet = True

    def pass_on(socket: "WebSocketRoute") -> None:
        if greet:
            socket.connect_to_server()

    page.route_web_socket("**/api/v1/stream*", pass_on)
    page.reload()
    points(page).first.wait_for()
    turn = (
        "state => { Object.defineProperty(document, 'visibilityState',"
        " {configurable: true, get: () => state});"
        " document.dispatchEvent(new Event('visibilitychange')); }"
    )
    page.evaluate(turn, "hidden")
    greet = False
    page.evaluate(turn, "visible")
    again = page.get_by_role("alert").filter(has_text=f"Connecting again. {OLD}")
    assert again.is_visible()
    greet = True
    again.wait_for(state="detached")
    page.get_by_role("alert").filter(has_text=OLD).wait_for(state="detached")


def test_banner_of_the_tools_covers_no_navigation(visit: Visit):
    httpx.post(f"{visit.url}/api/v1/devices/sim/stop", timeout=60).raise_for_status()
    try:
        visit.screen("Tools")
        # Of this screen: that of the one before may be there for a moment, and have no place.
        tools = visit.page.get_by_role("region", name="Tools", exact=True)
        banner = tools.get_by_role("alert").filter(has_text="The device is not running")
        banner.wait_for()
        below = "bar => bar.getBoundingClientRect().top - {}.bottom"
        header = "document.querySelector('header.top').getBoundingClientRect()"
        assert banner.evaluate(below.format(header)) >= 0
    finally:
        httpx.post(f"{visit.url}/api/v1/devices/sim/start", timeout=60).raise_for_status()


def test_table_twin_has_the_sensors_of_the_calibration(visit: Visit):
    show(visit.url, {"kind": "rotating-bar"})
    sensors = visit.page.get_by_role("region", name="Sensors").last.locator("tbody tr")
    sensors.first.wait_for()
    device = httpx.get(f"{visit.url}/api/v1/devices/sim", timeout=60).json()
    assert sensors.count() == len(device["sensors"])
    assert sensors.first.locator("td").first.inner_text() == device["sensors"][0]["name"]
    assert re.search(r"-?\d+\.\d, -?\d+\.\d, -?\d+\.\d", sensors.first.inner_text())


def test_numbers_are_copied_where_the_browser_has_no_clipboard(visit: Visit):
    show(visit.url, {"kind": "rotating-bar"})
    page = visit.page
    page.add_init_script(
        "Object.defineProperty(Navigator.prototype, 'clipboard', {get: () => undefined})"
    )
    page.reload()
    row = points(page).first.get_by_role("button")
    row.click()
    copy = page.get_by_role("button", name="Copy")
    copy.click()
    page.get_by_role("button", name="Copied").wait_for()
    visit.screen("Calibrate")
    field = page.get_by_label("Table", exact=True)
    field.press("Control+v")
    assert '"position_mm"' in field.input_value()


def test_question_takes_the_focus_and_gives_it_back(visit: Visit):
    body = {"name": "asked", "scopes": ["read:stream"]}
    made = httpx.post(f"{visit.url}/api/v1/keys", json=body, timeout=60).raise_for_status().json()
    page = visit.page
    visit.screen("Administration")
    row = page.get_by_role("row", name=re.compile(r"^asked "))
    revoke = row.get_by_role("button", name="Revoke")
    revoke.focus()
    page.keyboard.press("Enter")
    question = row.get_by_role("group", name="Revoke asked?")
    assert question.evaluate("node => node === document.activeElement")
    page.keyboard.press("Escape")
    revoke.wait_for()
    assert revoke.evaluate("node => node === document.activeElement")
    page.keyboard.press("Enter")
    page.keyboard.press("Tab")
    page.keyboard.press("Enter")
    row.get_by_text("revoked", exact=True).wait_for()
    assert made["id"] in row.inner_text()
