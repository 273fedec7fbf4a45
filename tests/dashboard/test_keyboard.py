"""The whole calibration wizard by keyboard: nothing is clicked, and the focus is never lost."""

import re
from typing import TYPE_CHECKING

import httpx
import pytest

from hardware.simulated.calibration_target import calibration_target_points_mm
from tests.dashboard.conftest import Visit
from tests.dashboard.test_pages import serious_findings, show

if TYPE_CHECKING:
    from playwright.sync_api import Locator, Page

pytestmark = pytest.mark.slow

MAX_TABS = 150


def has_focus(wanted: "Locator") -> bool:
    focused: bool = wanted.evaluate("control => control === document.activeElement")
    return focused


def reach(page: "Page", wanted: "Locator", key: str = "Tab") -> None:
    """Press Tab until a control has the focus."""
    wanted.wait_for()
    for _ in range(MAX_TABS):
        page.keyboard.press(key)
        if has_focus(wanted):
            return
    pytest.fail(f"Tab does not reach {wanted}")


def test_device_is_calibrated_by_keyboard_alone(visit: Visit):
    show(visit.url, {"kind": "calibration-frame"})
    page = visit.page

    def button(name: str | re.Pattern[str]) -> "Locator":
        return page.get_by_role("button", name=name, exact=True)

    reach(page, page.get_by_role("link", name="Calibrate", exact=True))
    page.keyboard.press("Enter")
    points = page.get_by_label("Calibrate by points at known positions")
    reach(page, points)
    page.keyboard.press("ArrowDown")
    page.keyboard.press("ArrowUp")
    assert points.is_checked()
    # A regular grid fills the table.
    reach(page, page.locator("summary", has_text="or a regular grid"))
    page.keyboard.press("Enter")
    reach(page, page.get_by_label("Targets along X, Y, Z"))
    page.keyboard.press("Control+A")
    page.keyboard.type("3, 2, 2")
    reach(page, button("Fill the table with 12 targets"))
    page.keyboard.press("Space")
    page.get_by_text("12 targets read.").wait_for()
    # The simulated frame has its markers elsewhere.
    table = page.get_by_label("Table", exact=True)
    assert table.input_value().splitlines()[:3] == [
        "name\tX [mm]\tY [mm]\tZ [mm]",
        "1\t-200\t-200\t1300",
        "2\t0\t-200\t1300",
    ]
    lines = ["name;X;Y;Z;marker"]
    for number, (x, y, z) in enumerate(calibration_target_points_mm()):
        lines.append(f"LED {number + 1};{x:.3f};{y:.3f};{z:.3f};{number}")
    reach(page, table)
    page.keyboard.press("Control+A")
    page.keyboard.type("\n".join(lines))
    page.get_by_text("19 targets read.").wait_for()
    reach(page, button("Begin capturing"))
    page.keyboard.press("Enter")
    # One target, and then another one than the page proposes; the focus stays where it is.
    status = page.locator(".capture [role=status]")
    reach(page, button("Capture"))
    page.keyboard.press("Enter")
    page.get_by_text("1 of 19 captured").wait_for()
    assert has_focus(button("Capture"))
    proposed = status.inner_text()
    assert proposed not in ("LED 1", "LED 2"), "the first two are neighbours"
    reach(page, page.get_by_label("or another one"))
    page.keyboard.press("ArrowDown")
    status.filter(has_text=re.compile("^LED 2$")).wait_for()
    reach(page, button("Capture"), "Shift+Tab")
    page.keyboard.press("Space")
    page.get_by_text("2 of 19 captured").wait_for()
    assert has_focus(button("Capture"))
    captured = page.get_by_role("region", name="Captured targets").locator("tbody tr")
    assert [row.split("\t")[0] for row in captured.all_inner_texts()] == ["LED 1", "LED 2"]
    reach(page, button("Capture all"))
    page.keyboard.press("Enter")
    page.get_by_text("ALL CAPTURED").wait_for()
    assert has_focus(button("Capture all"))
    page.get_by_text(re.compile("of 8 parts of the volume have a captured target")).wait_for()
    assert not serious_findings(page)
    reach(page, button("Compute the calibration"))
    page.keyboard.press("Enter")
    page.get_by_text("left out one by one: what a new marker will have").wait_for()
    before = httpx.get(f"{visit.url}/api/v1/devices/sim").json()["active_calibration_id"]
    reach(page, button("Activate"))
    page.keyboard.press("Enter")
    result = page.get_by_role("region", name=re.compile("^Calibration "))
    result.get_by_text("active", exact=True).wait_for()
    active = httpx.get(f"{visit.url}/api/v1/devices/sim").json()["active_calibration_id"]
    assert active != before
    found = httpx.get(f"{visit.url}/api/v1/calibrations/{active}").json()
    assert max(found["errors"]["leave_one_out"]["statistics"]["mean_absolute_mm"]) < 1.0
