"""A recording in the player: stepped, played, with its scans, under two calibrations."""

import copy
import re
import time
from typing import Any

import httpx
import pytest

from service.api.calibrations.examples import NEW_CALIBRATIONS
from tests.dashboard.conftest import Visit
from tests.dashboard.test_pages import serious_findings, show

pytestmark = pytest.mark.slow

SHIFT_MM = 5.0
POSITION = re.compile(r"frame (\d+) of \d+, ")


def number(visit: Visit) -> int:
    """Return the number of the frame that is shown."""
    found = POSITION.search(visit.page.get_by_text(POSITION).inner_text())
    assert found
    return int(found[1])


def record(server: str, name: str) -> None:
    """Record the simulated device's turning bar for half a second, and stop the device."""
    show(server, {"kind": "rotating-bar"})
    api = f"{server}/api/v1"
    recording = httpx.post(f"{api}/devices/sim/recordings", json={"id": name}, timeout=60)
    recording.raise_for_status()
    while httpx.get(f"{api}/recordings/{name}").json()["frames_written"] < 500:
        time.sleep(0.1)
    httpx.post(f"{api}/recordings/{name}/stop", timeout=60).raise_for_status()
    httpx.post(f"{api}/devices/sim/stop", timeout=60).raise_for_status()


def shifted_points() -> list[dict[str, Any]]:
    """Return control points in a world that is shifted by SHIFT_MM along X."""
    points: list[dict[str, Any]] = copy.deepcopy(NEW_CALIBRATIONS["frame"]["value"]["points"])
    for point in points:
        point["position_mm"][0] += SHIFT_MM
    return points


def test_recording_is_shown_under_two_calibrations(visit: Visit):
    record(visit.url, "beside.h5")
    body = {"id": "shifted", "device_id": "sim", "points": shifted_points()}
    httpx.post(f"{visit.url}/api/v1/calibrations", json=body, timeout=60).raise_for_status()
    page = visit.page
    visit.screen("Recordings")
    page.get_by_role("row", name=re.compile("beside")).get_by_role("button", name="Open").click()
    page.get_by_label("Position in the recording").fill("300")
    page.get_by_label("Beside calibration").select_option("shifted")
    beside = page.get_by_role("region", name="Differences of the two calibrations").last
    x = beside.get_by_role("row", name=re.compile("^X "))
    x.wait_for()
    check_shift(x.locator("td").all_inner_texts())
    assert not serious_findings(page)
    page.get_by_role("button", name="Over the whole recording").click()
    page.get_by_text(re.compile(r"of [4-9]\d\d points in frames spread")).wait_for()
    check_shift(x.locator("td").all_inner_texts())
    page.get_by_role("button", name="One frame on").click()
    assert number(visit) == 301
    page.get_by_label("Beside calibration").select_option("none")
    beside.wait_for(state="detached")


def check_shift(cells: list[str]) -> None:
    """Check that median, 95 % and largest are the shift."""
    assert all(abs(float(cell) - SHIFT_MM) < 0.5 for cell in cells[1:]), cells


def test_recording_is_played_with_scene_and_scans(visit: Visit):
    record(visit.url, "played.h5")
    page = visit.page
    visit.screen("Recordings")
    page.get_by_role("row", name=re.compile("played")).get_by_role("button", name="Open").click()
    page.get_by_role("button", name="One frame on").click()
    assert number(visit) == 1
    page.get_by_label("Position in the recording").fill("300")
    points = page.get_by_role("region", name="Points").locator("tbody tr")
    points.first.wait_for()
    page.get_by_label("Speed").select_option("0.1")
    page.get_by_role("button", name="Play", exact=True).click()
    page.get_by_text(re.compile(r"frame (3[1-9]\d|[4-9]\d\d|\d{4,}) of")).wait_for()
    page.get_by_role("button", name="Pause").click()
    page.get_by_label("Scans").check()
    page.get_by_role("button", name="1: zoom").wait_for()
    page.get_by_role("button", name="One frame back").focus()
    before = number(visit)
    page.keyboard.press("Enter")
    page.get_by_text(f"frame {before - 1} of").wait_for()
