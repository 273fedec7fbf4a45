"""Pictures of the dashboard's screens, from the real service and a Chromium of this machine.

Run by ``make screenshots``; the pictures are ``docs/dashboard/*.png``.
"""

import json
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Final

import httpx
from playwright.sync_api import Page, sync_playwright

from service.cli.service_process import service_process

DOCS: Final = Path(__file__).parents[1]
PICTURES: Final = DOCS / "dashboard"
SCREENS: Final = {
    "scene": "Scene",
    "scans": "Scans",
    "calibrate": "Calibrate",
    "tools": "Tools",
    "beam-holds": "Beam holds",
    "recordings": "Recordings",
    "quality": "Quality",
    "plan": "Plan",
    "health": "Health",
    "administration": "Administration",
}
BROWSER: Final = ("--disable-background-networking", "--no-first-run", "--use-angle=swiftshader")
HOLD: Final = {
    "id": "chest",
    "device_id": "sim",
    "title": "Chest",
    "watch": {"kind": "tool", "tool_id": "pointer"},
    "limits": {"shift_mm": 2},
}
CHECKS: Final = 10
CHECK: Final = {
    "kind": "point-to-point",
    "markers": [0, 1],
    "reference_mm": 80.0,
    "duration_s": 0.5,
    "tolerance_mm": 0.2,
}
METRICS_MS: Final = 8_000
"""Until the page has two readings of the server's metrics, and something between them."""


def show_details(page: Page, name: str) -> None:
    """Bring a screen to what its picture is to show."""
    if name == "recordings":
        page.get_by_role("button", name="Open").click()
        page.get_by_label("Position in the recording").fill("1500")
        shown = page.locator('.count[aria-busy="false"]').get_by_text("frame 1500")
        shown.wait_for(timeout=120_000)
        page.locator(".stale").wait_for(state="detached")
    elif name == "plan":
        page.get_by_role("heading", name="What it would reach").wait_for()
        page.get_by_label("Baseline").fill("0.5")
        page.locator(".stale").wait_for()
        page.locator(".stale").wait_for(state="detached")
    elif name == "scans":
        page.get_by_role("button", name="Freeze").click()
        page.get_by_role("button", name="1: zoom").click()
        page.evaluate("scrollTo(0, 0)")
    elif name == "tools":
        page.get_by_role("button", name="pointer", exact=True).click()
        page.get_by_role("region", name="Pivot and spin", exact=True).wait_for()
    elif name == "health":
        page.wait_for_timeout(METRICS_MS)


def prepare(api: httpx.Client) -> None:
    """Let the simulated device show a tool that a beam hold watches, and record it."""
    moving = json.loads((DOCS / "examples" / "moving-tool.json").read_text())
    api.patch("/devices/sim", json=moving, headers={"If-Match": "*"}).raise_for_status()
    api.post("/devices/sim/start").raise_for_status()
    tool = json.loads((DOCS / "examples" / "tool.json").read_text())
    api.post("/tools", json=tool).raise_for_status()
    api.post("/beam-holds", json=HOLD).raise_for_status()
    api.post("/devices/sim/recordings", json={"id": "morning.h5"}).raise_for_status()
    for _ in range(CHECKS):
        api.post("/devices/sim/quality-checks", json=CHECK).raise_for_status()
    api.post("/recordings/morning.h5/stop").raise_for_status()


def main() -> int:
    """Write the pictures; 1 where there is no browser."""
    browser_path = shutil.which("chromium") or shutil.which("google-chrome")
    if browser_path is None:
        print("screenshots need Chromium", file=sys.stderr)
        return 1
    PICTURES.mkdir(exist_ok=True)
    with (
        tempfile.TemporaryDirectory() as folder,
        service_process(Path(folder)) as service,
        httpx.Client(base_url=f"{service.url}/api/v1", timeout=120) as api,
        sync_playwright() as playwright,
    ):
        prepare(api)
        browser = playwright.chromium.launch(executable_path=browser_path, args=list(BROWSER))
        page = browser.new_page(viewport={"width": 1100, "height": 760})
        page.set_default_timeout(120_000)
        page.goto(service.url)
        tools = page.get_by_role("region", name="Tools").last
        tools.get_by_text("OK", exact=True).wait_for()
        tools.get_by_role("button", name="pointer").click()
        for name, title in SCREENS.items():
            page.get_by_role("link", name=title, exact=True).click()
            page.wait_for_timeout(2_500)
            show_details(page, name)
            page.wait_for_timeout(1_500)
            page.screenshot(path=PICTURES / f"{name}.png")
        browser.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
