"""Tools that are made, pivoted, touched with, lost and found; a beam hold that is acknowledged."""

import json
from collections.abc import Iterator
from typing import Any

import httpx
import pytest

from tests.dashboard.conftest import Visit
from tests.dashboard.test_pages import serious_findings, show

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
def tool(server: str) -> Iterator[None]:
    """A tool at rest."""
    place(server, 0.0)
    httpx.post(f"{server}/api/v1/tools", json=TOOL, timeout=60).raise_for_status()
    yield
    httpx.delete(f"{server}/api/v1/tools/pointer", timeout=60).raise_for_status()


def place(server: str, shift_mm: float) -> None:
    """Let the tool rest so far from the middle of the volume, along X."""
    tool = {"markers_mm": MARKERS, "centre_mm": [shift_mm, 0, 1500]}
    show(server, {"kind": "moving-tools", "tools": [tool], "moving": False})


def pivot(server: str, tip_at_mm: tuple[float, float, float]) -> None:
    """Let the tool swing about its tip, which stays."""
    tool = {
        "markers_mm": MARKERS,
        "centre_mm": tip_at_mm,
        "held_mm": TOOL["tip_mm"],
        "swing_mm": [0, 0, 0],
        "period_s": 2.0,
    }
    show(server, {"kind": "moving-tools", "tools": [tool]})


@pytest.fixture
def no_tool(server: str) -> Iterator[None]:
    """What a test makes is removed after it; coordinates are those of the nominal calibration."""
    activate = f"{server}/api/v1/calibrations/sim-nominal/activate"
    httpx.post(activate, timeout=60).raise_for_status()
    place(server, 0.0)
    yield
    for path in ("registrations/phantom", "tools/pointer"):
        httpx.delete(f"{server}/api/v1/{path}", timeout=60)


FIDUCIALS = {"A": (-60.0, -40.0, 1500.0), "B": (60.0, -40.0, 1480.0), "C": (0.0, 60.0, 1520.0)}


@pytest.mark.usefixtures("no_tool")
def test_tool_is_made_pivoted_and_registers_a_phantom(visit: Visit):
    page = visit.page
    visit.screen("Tools")
    page.get_by_label("from a file").check()
    table = "name;X;Y;Z;marker\n" + "".join(
        f"{number};{x};{y};{z};{number}\n" for number, (x, y, z) in enumerate(MARKERS)
    )
    file = {"name": "tool.csv", "mimeType": "text/csv", "buffer": table.encode()}
    define = page.get_by_role("region", name="Define a tool")
    define.get_by_label("File", exact=True).set_input_files(file)
    define.get_by_text("write one into the field").wait_for()
    define.get_by_label("Id").fill("pointer")
    define.get_by_text("pointer (4 markers)").wait_for()
    define.get_by_role("button", name="Create").click()
    listed = page.get_by_role("region", name="Tools").last
    listed.get_by_text("OK", exact=True).wait_for()
    listed.get_by_text("no tip yet").wait_for()
    listed.get_by_role("button", name="pointer").click()
    # A tool that does not move is not smiled at.
    tip = page.get_by_role("region", name="Pivot and spin", exact=True)
    tip.get_by_label("For [s]").fill("2")
    tip.get_by_role("button", name="Pivot", exact=True).click()
    tip.get_by_role("alert").filter(has_text="Each must swing by at least 5.0 deg").wait_for()
    tip.get_by_text("More motion is needed").wait_for()
    pivot(visit.url, FIDUCIALS["A"])
    tip.get_by_label("For [s]").fill("4")
    tip.get_by_role("button", name="Pivot", exact=True).click()
    tip.get_by_text("Enough motion").wait_for()
    tip.get_by_text("Given to the tool.").wait_for()
    found = httpx.get(f"{visit.url}/api/v1/tools/pointer", timeout=60).json()["tip"]
    assert found["position_mm"] == pytest.approx(TOOL["tip_mm"], abs=1.0)
    points = page.get_by_role("region", name="Digitise points").first
    points.get_by_role("button", name="Measure", exact=True).click()
    row = points.locator("tbody tr").first.locator("td")
    row.first.wait_for()
    measured = [float(one) for one in row.nth(1).inner_text().split(",")]
    assert measured == pytest.approx(FIDUCIALS["A"], abs=1.0)
    # The phantom's own coordinates are those of the world, moved by (100, 200, 300) mm.
    make = page.get_by_role("region", name="Register a frame").first
    make.get_by_label("Name of the frame").fill("phantom")
    lines = [f"{name},{x + 100},{y + 200},{z + 300}" for name, (x, y, z) in FIDUCIALS.items()]
    make.get_by_label("Table of points").fill("\n".join(["name,X,Y,Z", *lines]))
    register = make.get_by_role("button", name="Register")
    for name, place_mm in FIDUCIALS.items():
        assert register.is_disabled()
        pivot(visit.url, place_mm)
        listed.get_by_text("OK", exact=True).wait_for()
        make.get_by_role("button", name=f"Measure {name}").click()
        make.get_by_role("button", name=f"Measure {name} again").wait_for()
    # A look at another screen loses nothing of what was measured.
    visit.screen("Health")
    page.get_by_role("heading", name="Devices and links").wait_for()
    visit.screen("Tools")
    row.first.wait_for()
    register.click()
    page.get_by_role("region", name="Registrations").get_by_role(
        "button", name="phantom"
    ).wait_for()
    # Both directions of a transform, with all digits to copy.
    page.context.grant_permissions(["clipboard-read", "clipboard-write"])
    frames = page.get_by_role("region", name="Frames")
    frames.get_by_role("listitem").filter(has_text="phantom").first.wait_for()
    frames.get_by_role("combobox", name="From").select_option("phantom")
    frames.get_by_role("combobox", name="to", exact=True).select_option("tracker")
    back = frames.get_by_role("figure", name="takes coordinates in tracker to those in phantom")
    for figure, shift in (
        (frames.get_by_role("figure", name="takes coordinates in phantom to"), -1.0),
        (back, 1.0),
    ):
        page.evaluate("navigator.clipboard.writeText('')")
        figure.get_by_role("button", name="Copy").click()
        page.wait_for_function("navigator.clipboard.readText().then((text) => text.length > 0)")
        matrix = json.loads(page.evaluate("navigator.clipboard.readText()"))
        moved = [sum(matrix[i][j] * x for j, x in enumerate((0, 0, 1500))) for i in range(3)]
        at = [moved[i] + matrix[i][3] for i in range(3)]
        wanted = [shift * 100.0, shift * 200.0, 1500.0 + shift * 300.0]
        assert at == pytest.approx(wanted, abs=10.0)
    assert serious_findings(page) == []


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
        reason = hold.get_by_text("It has no reference yet: measure it")
        reason.wait_for()
        assert "/api/" not in hold.inner_text()
        # Read from three metres: letters of a centimetre.
        size_px: float = reason.evaluate("words => parseFloat(getComputedStyle(words).fontSize)")
        assert size_px > 30
        hold.get_by_role("button", name="Measure the reference").click()
        hold.get_by_role("button", name="Yes").click()
        hold.get_by_text("NOT HELD", exact=True).wait_for()
        place(visit.url, 20.0)
        hold.get_by_text("HELD", exact=True).wait_for()
        hold.get_by_text("Out of tolerance, or it may be.").wait_for()
        place(visit.url, 0.0)
        hold.get_by_role("button", name="Acknowledge").click()
        hold.get_by_text("NOT HELD", exact=True).wait_for()
    finally:
        httpx.delete(f"{visit.url}/api/v1/beam-holds/chest", timeout=60).raise_for_status()
