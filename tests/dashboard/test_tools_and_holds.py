"""A tool that is lost and found, and a beam hold that is raised and acknowledged."""

from typing import Any

import httpx
import pytest

from tests.dashboard.conftest import Visit
from tests.dashboard.test_pages import show

pytestmark = pytest.mark.slow

MARKERS = [[0, 0, 0], [80, 0, 0], [0, 60, 0], [20, 15, 40]]
AWAY_MM = 5_000.0
TOOL = {
    "id": "pointer",
    "device_id": "sim",
    "title": "Pointer",
    "markers_mm": MARKERS,
    "strobe_markers": [0, 1, 2, 3],
    "tip_mm": [-150, 0, 0],
}
HOLD: dict[str, Any] = {
    "id": "chest",
    "device_id": "sim",
    "title": "Chest",
    "watch": {"kind": "tool", "tool_id": "pointer"},
    "limits": {"shift_mm": 2},
    "rules": {"latched": True},
}


@pytest.fixture
def tool(server: str) -> Any:
    """A tool at rest."""
    place(server, 0.0)
    httpx.post(f"{server}/api/v1/tools", json=TOOL, timeout=60).raise_for_status()
    yield
    httpx.delete(f"{server}/api/v1/tools/pointer", timeout=60).raise_for_status()


def place(server: str, shift_mm: float) -> None:
    """Let the tool rest so far from the middle of the volume, along X."""
    tool = {"markers_mm": MARKERS, "centre_mm": [shift_mm, 0, 1500]}
    show(server, {"kind": "moving-tools", "tools": [tool], "moving": False})


@pytest.mark.usefixtures("tool")
def test_tool_is_lost_and_found_with_the_reason_shown(visit: Visit):
    row = visit.page.get_by_role("region", name="Tools").last.get_by_role("row", name="pointer")
    row.get_by_text("OK", exact=True).wait_for()
    place(visit.url, AWAY_MM)
    row.get_by_text("OK", exact=True).wait_for(state="detached")
    reason = row.locator("td").last
    reason.filter(has_text="last seen").wait_for()
    assert len(reason.inner_text().partition("last seen")[0]) > 20, reason.inner_text()
    place(visit.url, 0.0)
    row.get_by_text("OK", exact=True).wait_for()


@pytest.mark.usefixtures("tool")
def test_hold_is_raised_and_acknowledged(visit: Visit):
    httpx.post(f"{visit.url}/api/v1/beam-holds", json=HOLD, timeout=60).raise_for_status()
    try:
        visit.screen("Beam holds")
        hold = visit.page.get_by_role("article")
        hold.get_by_text("HELD", exact=True).wait_for()
        hold.get_by_role("button", name="Measure the reference").click()
        hold.get_by_role("button", name="Yes").click()
        hold.get_by_text("NOT HELD", exact=True).wait_for()
        place(visit.url, 20.0)
        hold.get_by_text("HELD", exact=True).wait_for()
        place(visit.url, 0.0)
        hold.get_by_role("button", name="Acknowledge").click()
        hold.get_by_text("NOT HELD", exact=True).wait_for()
    finally:
        httpx.delete(f"{visit.url}/api/v1/beam-holds/chest", timeout=60).raise_for_status()
