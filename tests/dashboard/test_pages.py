"""The dashboard in a real browser, against the real service."""

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import httpx
import pytest

from hardware.simulated.calibration_target import calibration_target_points_mm
from tests.dashboard.conftest import Visit

if TYPE_CHECKING:
    from playwright.sync_api import Page

pytestmark = pytest.mark.slow

AXE = Path(__file__).parents[2] / "dashboard" / "node_modules" / "axe-core" / "axe.min.js"
ANY = {"If-Match": "*"}
"""A change of the resource whatever it is."""
SCREENS = (
    *("Scene", "Scans", "Calibrate", "Tools", "Beam holds", "Recordings", "Quality"),
    *("Plan", "Health", "Administration"),
)


def show(server: str, scene: dict[str, Any]) -> None:
    """Let the simulated device show a scene, from its start."""
    source = {"kind": "simulated", "settings": {"scene": scene}}
    device = f"{server}/api/v1/devices/sim"
    httpx.patch(device, json={"source": source}, headers=ANY, timeout=60).raise_for_status()
    httpx.post(f"{device}/start", timeout=60).raise_for_status()


def serious_findings(page: "Page") -> list[tuple[str, list[str]]]:
    """What axe finds on a page that is serious or critical."""
    page.evaluate(AXE.read_text())
    found = page.evaluate("axe.run()")
    assert found["passes"]
    return [
        (violation["id"], [node["html"] for node in violation["nodes"]])
        for violation in found["violations"]
        if violation["impact"] in ("serious", "critical")
    ]


def test_scene_shows_the_markers_of_the_running_device(visit: Visit):
    show(visit.url, {"kind": "rotating-bar"})
    rows = visit.page.get_by_role("region", name="Points").locator("tbody tr")
    rows.first.wait_for()
    assert re.search(r"-?\d+\.\d+, -?\d+\.\d+, -?\d+\.\d+", rows.first.inner_text())


def test_scene_shows_the_volume_of_the_device(visit: Visit):
    show(visit.url, {"kind": "rotating-bar"})
    device = f"{visit.url}/api/v1/devices/sim"
    tracking = httpx.get(device, timeout=60).json()["tracking"]
    volume = {"volume_mm": [[-300, -200, 1800], [300, 200.5, 2600]]}
    httpx.patch(device, json={"tracking": tracking | volume}, headers=ANY).raise_for_status()
    try:
        page = visit.page
        page.get_by_text("x -300.0 … 300.0, y -200.0 … 200.5, z 1800 … 2600 mm").wait_for()
        for side in ("Top", "Front", "Side"):
            page.get_by_role("button", name=side, exact=True).click()
    finally:
        httpx.patch(device, json={"tracking": tracking}, headers=ANY).raise_for_status()


def test_open_capture_session_is_still_there_after_another_screen_and_a_reload(visit: Visit):
    targets = [{"name": str(n), "position_mm": [10.0 * n, 0.0, 2000.0 + n * n]} for n in range(12)]
    session = {"device_id": "sim", "id": "kept", "targets": targets}
    httpx.post(f"{visit.url}/api/v1/captures", json=session, timeout=60).raise_for_status()
    page = visit.page
    visit.screen("Calibrate")
    page.get_by_role("row", name="kept").get_by_role("button").click()
    page.get_by_role("heading", name="kept").wait_for()
    visit.screen("Beam holds")
    page.get_by_role("heading", name="kept").wait_for(state="detached")
    visit.screen("Calibrate")
    page.get_by_role("heading", name="kept").wait_for()
    page.reload()
    page.get_by_role("heading", name="kept").wait_for()
    page.get_by_role("button", name="Back", exact=True).click()
    page.get_by_role("row", name="kept").wait_for()
    httpx.delete(f"{visit.url}/api/v1/captures/kept").raise_for_status()


def test_scan_is_frozen_zoomed_and_saved(visit: Visit, tmp_path: Path):
    show(visit.url, {"kind": "calibration-frame"})
    page = visit.page
    visit.screen("Scans")
    page.get_by_role("button", name="1: zoom").wait_for()
    page.get_by_role("button", name="Freeze").click()
    exposure = page.get_by_role("definition").filter(has_text="marker")
    frozen = exposure.inner_text()
    page.get_by_role("button", name="1: zoom").click()
    page.wait_for_timeout(1000)
    assert exposure.inner_text() == frozen
    for name, start in (
        ("Save as CSV", b"pixel,vertical [counts]"),
        ("Save as picture", b"\x89PNG"),
    ):
        with page.expect_download() as download:
            page.get_by_role("button", name=name).click()
        download.value.save_as(tmp_path / name)
        assert (tmp_path / name).read_bytes().startswith(start)
    page.get_by_role("button", name="Next exposure").click()
    exposure.filter(has_not_text=frozen).wait_for()
    page.get_by_role("button", name=re.compile("^horizontal")).click()
    page.get_by_text("Only the sensor that was shown").wait_for()


def test_device_is_calibrated_by_clicks_alone(visit: Visit):
    show(visit.url, {"kind": "calibration-frame"})
    page = visit.page
    visit.screen("Calibrate")
    check = page.get_by_role("region", name="Light check")
    check.last.get_by_text("good", exact=True).first.wait_for()
    lines = ["name;X [mm];Y [mm];Z [mm];marker"]
    for number, (x, y, z) in enumerate(calibration_target_points_mm()):
        lines.append(f"LED {number + 1};{x:.3f};{y:.3f};{z:.3f};{number}".replace(".", ","))
    page.get_by_label("File").set_input_files(
        {"name": "frame.csv", "mimeType": "text/csv", "buffer": "\r\n".join(lines).encode("utf-16")}
    )
    page.get_by_text("19 targets read.").wait_for()
    page.get_by_role("button", name="Begin capturing").click()
    page.get_by_role("button", name="Capture all").click()
    page.get_by_text("ALL CAPTURED").wait_for()
    page.get_by_role("button", name="Compute the calibration").click()
    page.get_by_text("left out one by one: what a new marker will have").wait_for()
    page.get_by_role("button", name="Activate").click()
    result = page.get_by_role("region", name=re.compile("^Calibration "))
    result.get_by_text("active", exact=True).wait_for()
    device = httpx.get(f"{visit.url}/api/v1/devices/sim").json()
    found = httpx.get(f"{visit.url}/api/v1/calibrations/{device['active_calibration_id']}").json()
    assert found["provenance"] == "fitted"
    # The simulated sensors' readings are good to some hundredths of a pixel.
    assert max(found["errors"]["leave_one_out"]["statistics"]["mean_absolute_mm"]) < 1.0
    visit.screen("Scene")
    page.get_by_role("region", name="Points").locator("tbody tr").first.wait_for()


def test_wrong_table_of_targets_is_refused_with_what_to_change(visit: Visit):
    visit.screen("Calibrate")
    visit.page.get_by_label("Table", exact=True).fill("X,Y\n1,2\n")
    visit.page.get_by_text('There is no column Z in the heading "X,Y".').wait_for()
    assert visit.page.get_by_role("button", name="Begin capturing").is_disabled()


@pytest.mark.parametrize("name", ["<img src=x onerror=alert(1)>", "<script>alert(1)</script>"])
def test_markup_in_a_title_is_shown_as_text(visit: Visit, name: str):
    httpx.patch(
        f"{visit.url}/api/v1/devices/sim", json={"title": name}, headers=ANY
    ).raise_for_status()
    try:
        visit.page.get_by_role("option", name=name).wait_for(state="attached")
    finally:
        body = {"title": "Simulated"}
        httpx.patch(f"{visit.url}/api/v1/devices/sim", json=body, headers=ANY).raise_for_status()


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("screen", SCREENS)
def test_no_serious_finding_of_axe(visit: Visit, screen: str, scheme: Any):
    visit.page.emulate_media(color_scheme=scheme)
    visit.screen(screen)
    visit.page.get_by_role("heading", name=screen, level=1).wait_for(state="attached")
    visit.page.wait_for_timeout(1000)
    assert not serious_findings(visit.page)


@pytest.mark.parametrize("screen", ["Beam holds", "Tools", "Health"])
def test_screen_fits_a_phone(visit: Visit, screen: str):
    visit.page.set_viewport_size({"width": 375, "height": 700})
    visit.screen(screen)
    visit.page.wait_for_timeout(500)
    assert visit.page.evaluate("document.documentElement.scrollWidth") <= 375


def test_planned_profile_is_changed_kept_and_simulated(visit: Visit):
    page = visit.page
    visit.screen("Plan")
    page.get_by_role("heading", name="What it would reach").wait_for()
    page.get_by_label("Baseline").fill("0.5")
    better = page.get_by_role("row", name=re.compile("^Precision .noise., median"))
    better.get_by_text(re.compile(r"^−\d+ %$")).wait_for()
    simulate = page.get_by_role("button", name="Simulate it as a device")
    assert simulate.is_disabled()
    page.get_by_label("Name").fill("planned")
    page.get_by_role("button", name="Keep the profile").click()
    page.get_by_text('Simulated is the profile "planned"').wait_for()
    page.get_by_role("option", name="planned").wait_for(state="attached")
    device = f"{visit.url}/api/v1/devices/planned"
    simulate.click()
    # One click: the device is calibrated by its profile, started, and its points are in the scene.
    page.get_by_text("The active calibration is nominal").wait_for()
    state = httpx.get(f"{device}/state", timeout=10).json()
    assert (state["state"], state["calibration_id"]) == ("running", "planned-nominal")
    page.get_by_role("region", name="Points").locator("tbody tr").first.wait_for()
    assert httpx.get(device, timeout=10).json()["source"]["settings"]["frame_rate_hz"] == 50
    lost = httpx.get(f"{device}/state", timeout=10).json()
    assert lost["frames_lost"] + lost["frames_dropped_compute"] <= 0.2 * lost["frames_received"]
    httpx.delete(f"{device}?cascade=true", headers=ANY, timeout=60).raise_for_status()


def test_profile_device_without_calibration_is_offered_the_nominal_one(visit: Visit):
    page = visit.page
    device = f"{visit.url}/api/v1/devices/offered"
    source = {"kind": "profile", "profile_id": "bar", "settings": {"frame_rate_hz": 50}}
    new = {"id": "offered", "title": "Offered", "source": source}
    httpx.post(f"{visit.url}/api/v1/devices", json=new, timeout=60).raise_for_status()
    httpx.post(f"{device}/start", timeout=60).raise_for_status()
    page.reload()
    page.get_by_role("combobox", name="Device").select_option("offered")
    visit.screen("Scene")
    page.get_by_text("The device has no active calibration").wait_for()
    page.get_by_role("button", name="Use the profile's nominal calibration").click()
    page.get_by_text("The active calibration is nominal").wait_for()
    page.get_by_role("region", name="Points").locator("tbody tr").first.wait_for()
    httpx.delete(f"{device}?cascade=true", headers=ANY, timeout=60).raise_for_status()


def test_sliders_keep_what_was_edited_and_the_profile_as_it_was(visit: Visit):
    page = visit.page
    visit.screen("Plan")
    # Before the first answer: what is compared with is the profile as it is, all the same.
    page.get_by_label("Exposure").fill("0.3")
    bound = page.get_by_role("row", name=re.compile("^Precision .noise., median"))
    bound.get_by_text(re.compile(r"^−\d+(\.\d+)? %$")).wait_for()
    page.get_by_text("The profile's file", exact=True).click()
    file = page.get_by_role("textbox", name="The profile's file")
    edited = f"# edited\n{file.input_value()}"
    file.fill(edited)
    page.get_by_label("Baseline").fill("0.5")
    assert file.input_value().startswith("# edited\n")
    assert file.input_value() != edited
    page.get_by_role("combobox", name="Profile").select_option(index=1)
    page.get_by_role("heading", name="What it would reach").wait_for()
    page.get_by_text("The profile's file", exact=True).click()
    assert not file.input_value().startswith("# edited\n")


def test_quick_check_says_what_it_found_and_what_to_do(visit: Visit):
    show(visit.url, {"kind": "rotating-bar"})
    page = visit.page
    visit.screen("Quality")
    checks = page.get_by_role("region", name="Quick checks").first
    checks.get_by_label("Kind").select_option("point-to-point")
    checks.get_by_label("Strobed markers").fill("0, 1")
    checks.get_by_label("Distance [mm]").fill("292")
    checks.get_by_label("Seconds").fill("0.5")
    checks.get_by_role("button", name="Measure").click()
    checks.get_by_text("passed", exact=True).wait_for()
    checks.get_by_text(re.compile("error .* mm on average")).wait_for()
    page.get_by_text("mean error of the distance").first.wait_for()
