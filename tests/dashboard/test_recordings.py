"""A recording in the player: stepped, played, with its scans, under two calibrations."""

import copy
import re
import time
from typing import TYPE_CHECKING, Any

import httpx
import pytest

from service.api.calibrations.examples import NEW_CALIBRATIONS
from tests.dashboard.conftest import Visit
from tests.dashboard.test_pages import ANY, serious_findings, show

if TYPE_CHECKING:
    from playwright.sync_api import Route

pytestmark = pytest.mark.slow

SHIFT_MM = 5.0
ALL = ("lines", "results")
POSITION = re.compile(r"frame (\d+) of \d+, ")


def number(visit: Visit) -> int:
    """Return the number of the frame that is shown."""
    found = POSITION.search(visit.page.get_by_text(POSITION).inner_text())
    assert found
    return int(found[1])


BAR = {"kind": "rotating-bar"}
MARKERS_MM = [[0, 0, 0], [80, 0, 0], [0, 60, 0], [20, 15, 40]]


def record(
    server: str, name: str, scene: dict[str, Any] = BAR, contents: tuple[str, ...] = ALL
) -> None:
    """Record what the simulated device shows for half a second, and stop the device."""
    show(server, scene)
    api = f"{server}/api/v1"
    body = {"id": name, "contents": contents}
    recording = httpx.post(f"{api}/devices/sim/recordings", json=body, timeout=60)
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


def settle(page: Any) -> None:
    """Wait until the scene is that of the position: a busy server takes a while."""
    page.locator("[aria-busy=true]").wait_for(state="detached")


def test_recorded_tools_and_tracks_are_shown_as_live(visit: Visit):
    record(visit.url, "tool.h5", {"kind": "moving-tools", "tools": [{"markers_mm": MARKERS_MM}]})
    tool = {"id": "pointer", "device_id": "sim", "title": "Pointer", "markers_mm": MARKERS_MM}
    body = tool | {"strobe_markers": [0, 1, 2, 3]}
    httpx.post(f"{visit.url}/api/v1/tools", json=body, timeout=60).raise_for_status()
    try:
        page = visit.page
        visit.screen("Recordings")
        page.get_by_role("row", name=re.compile("tool")).get_by_role("button", name="Open").click()
        page.get_by_label("Position in the recording").fill("450")
        row = page.get_by_role("region", name="Tools").get_by_role(
            "row", name=re.compile("pointer")
        )
        settle(page)
        row.get_by_text("OK", exact=True).wait_for()
        tracks = page.get_by_role("region", name="Tracks").locator("tbody tr")
        tracks.nth(3).wait_for()
        named = tracks.locator("button").all_inner_texts()
        page.get_by_role("button", name="One frame on").click()
        assert number(visit) == 451
        settle(page)
        row.get_by_text("OK", exact=True).wait_for()
        assert tracks.locator("button").all_inner_texts() == named
        assert not serious_findings(page)
        page.get_by_label("Tracks and tools").uncheck()
        row.wait_for(state="detached")
        page.get_by_role("region", name="Points").locator("tbody tr").first.wait_for()
    finally:
        httpx.delete(f"{visit.url}/api/v1/tools/pointer", headers=ANY, timeout=60)


def test_points_of_recorded_scans_alone_are_worked_out(visit: Visit):
    record(visit.url, "scans.h5", contents=("lines",))
    page = visit.page
    visit.screen("Recordings")
    page.get_by_role("row", name=re.compile("scans")).get_by_role("button", name="Open").click()
    page.get_by_label("Position in the recording").fill("200")
    page.get_by_role("region", name="Points").locator("tbody tr").first.wait_for()
    page.get_by_label("Beside calibration").select_option("sim-nominal")
    page.get_by_role("button", name="Over the whole recording").click()
    page.get_by_text(re.compile(r"of [4-9]\d\d points in frames spread")).wait_for()
    page.get_by_text("worked out now (").wait_for()


TRACKING = re.compile(r"/frames\?.*tracking=true")
BUSY = {"type": "/problems/busy", "title": "Busy", "status": 503, "detail": "4 requests wait"}
ENDED = {"type": "/problems/worker-ended", "title": "Ended", "status": 500, "detail": "it ended"}


def test_player_asks_a_busy_server_again(visit: Visit):
    record(visit.url, "busy.h5")
    page = visit.page
    refused = []

    def refuse(route: "Route") -> None:
        refused.append(route.request.url)
        route.fulfill(status=503, json=BUSY, content_type="application/problem+json")

    page.route(TRACKING, refuse, times=2)
    visit.screen("Recordings")
    page.get_by_role("row", name=re.compile("busy")).get_by_role("button", name="Open").click()
    page.get_by_text("4 requests wait").wait_for()
    page.get_by_role("region", name="Tracks").locator("tbody tr").first.wait_for()
    page.get_by_text("4 requests wait").wait_for(state="detached")
    assert len(refused) == 2


def test_player_shows_frames_without_tracking_where_that_fails(visit: Visit):
    record(visit.url, "ended.h5")
    page = visit.page
    page.route(
        TRACKING,
        lambda route: route.fulfill(
            status=500, json=ENDED, content_type="application/problem+json"
        ),
    )
    visit.screen("Recordings")
    page.get_by_role("row", name=re.compile("ended")).get_by_role("button", name="Open").click()
    page.get_by_text(re.compile("Without tracks and tools.*it ended")).wait_for()
    page.get_by_label("Position in the recording").fill("300")
    page.get_by_role("region", name="Points").locator("tbody tr").first.wait_for()
    page.locator(".scene .stale").first.wait_for(state="detached")
    page.get_by_role("button", name="Play", exact=True).click()
    page.get_by_text(re.compile(r"frame (3[1-9]\d|[4-9]\d\d|\d{4,}) of")).wait_for()
    page.unroute(TRACKING)
    page.get_by_label("Tracks and tools").check()
    page.get_by_text("it ended").wait_for(state="detached")
    page.get_by_role("region", name="Tracks").locator("tbody tr").first.wait_for()


def test_scene_of_before_a_jump_is_shown_as_old(visit: Visit):
    record(visit.url, "late.h5")
    page = visit.page
    visit.screen("Recordings")
    page.get_by_role("row", name=re.compile("late")).get_by_role("button", name="Open").click()
    page.get_by_role("region", name="Tracks").locator("tbody tr").first.wait_for()
    # Without an answer; another choice does not wait for it.
    page.route(TRACKING, lambda _route: None)
    page.get_by_label("Position in the recording").fill("300")
    page.locator("canvas.stale").wait_for()
    page.get_by_label("Tracks and tools").uncheck()
    page.locator("canvas.stale").wait_for(state="detached")
    assert number(visit) == 300
    page.unroute_all(behavior="ignoreErrors")
