"""The volume mapped, and a drift found and taken away, by clicks alone."""

import re
from collections.abc import Iterator
from typing import Any

import httpx
import numpy as np
import pytest

from compute.camera.stack import CameraStack
from hardware.simulated.calibration_target import calibration_target_points_mm
from hardware.simulated.simulated_rig import (
    WORKING_CENTRE_MM,
    simulated_rig,
    simulated_sensor_models,
)
from tests.compute.rig import turned_about_lens
from tests.dashboard.conftest import Visit
from tests.dashboard.test_pages import serious_findings, show

pytestmark = pytest.mark.slow

TURNED_RAD = 2e-3
SIGMA_PX = 0.05
"""More than the simulated readings err by, so that only what turned is found."""
MARKUP = "<img src=x onerror=\"document.title='broken'\">"


def calibration_of_turned_sensor() -> dict[str, Any]:
    """Return the calibration of the simulated device as it was before its first sensor turned."""
    models = list(simulated_sensor_models())
    lens = np.array(simulated_rig()[0].lens_position_mm)
    models[0] = turned_about_lens(models[0], [0.0, TURNED_RAD, 0.0], lens)
    points = np.asarray(WORKING_CENTRE_MM) + calibration_target_points_mm() * 1.1
    readings = CameraStack.of(tuple(models)).project(points).round(3)
    names = [model.name for model in models]
    return {
        "id": "before-turn",
        "device_id": "sim",
        "points": [
            {
                "name": f"P{index + 1}",
                "position_mm": point,
                "readings": {
                    name: {"position_px": reading, "sigma_px": SIGMA_PX}
                    for name, reading in zip(names, row, strict=True)
                },
            }
            for index, (point, row) in enumerate(
                zip(points.tolist(), readings.tolist(), strict=True)
            )
        ],
    }


@pytest.fixture
def before_turn(server: str) -> Iterator[str]:
    """The device with a calibration that was made before one of its sensors turned."""
    show(server, {"kind": "calibration-frame"})
    api = f"{server}/api/v1"
    active = httpx.get(f"{api}/devices/sim").json()["active_calibration_id"]
    if httpx.get(f"{api}/calibrations/before-turn").status_code == 404:
        made = httpx.post(f"{api}/calibrations", json=calibration_of_turned_sensor(), timeout=60)
        made.raise_for_status()
    httpx.post(f"{api}/calibrations/before-turn/activate", timeout=60).raise_for_status()
    yield "before-turn"
    httpx.post(f"{api}/calibrations/{active}/activate", timeout=60).raise_for_status()


def capture_frame(visit: Visit, way: str) -> None:
    """Capture the frame's markers for a purpose; the first has markup as its name."""
    page = visit.page
    visit.screen("Calibrate")
    page.get_by_role("radio", name=way).check()
    lines = ["name\tX\tY\tZ\tmarker"]
    for number, (x, y, z) in enumerate(calibration_target_points_mm()):
        name = f"LED {number}" if number else MARKUP
        lines.append(f"{name}\t{x:.3f}\t{y:.3f}\t{z + WORKING_CENTRE_MM[2]:.3f}\t{number}")
    page.get_by_label("Table", exact=True).fill("\n".join(lines))
    page.get_by_role("button", name="Begin capturing").click()
    page.get_by_role("button", name="Capture all").click()
    page.get_by_text("ALL CAPTURED").wait_for()


@pytest.mark.usefixtures("before_turn")
def test_volume_is_mapped_and_the_table_activated(visit: Visit):
    capture_frame(visit, "Map the volume")
    page = visit.page
    page.get_by_role("button", name="Compute the correction table").click()
    result = page.get_by_role("region", name=re.compile("^Correction table table-"))
    errors = result.get_by_role("region", name="Errors of the readings, RMS [px]")
    errors.wait_for()
    row = errors.locator("tbody tr").first.locator("td").all_inner_texts()
    assert float(row[1]) < 0.5 * float(row[2]), row
    where = result.get_by_role("region", name="Where the table supports readings")
    assert re.search(r"measurements support \d+ % of the volume", where.inner_text())
    result.get_by_text(re.compile("^helps")).wait_for()
    assert not serious_findings(page)
    result.get_by_role("button", name="Activate").click()
    result.get_by_text("active", exact=True).wait_for()
    device = f"{visit.url}/api/v1/devices/sim"
    assert httpx.get(device).json()["active_table_id"].startswith("table-")
    tables = page.get_by_role("region", name="Correction tables of the device")
    result.get_by_role("button", name="Close").click()
    opened = tables.locator("tbody button").first
    opened.press("Enter")
    assert result.get_by_role("heading", level=2).evaluate("one => one === document.activeElement")
    result.get_by_role("button", name="Close").press("Enter")
    assert opened.evaluate("one => one === document.activeElement")
    opened.press("Enter")
    result.get_by_role("button", name="Stop using it").click()
    result.get_by_role("button", name="Activate").wait_for()
    assert httpx.get(device).json()["active_table_id"] is None


@pytest.mark.usefixtures("before_turn")
def test_drift_is_found_and_the_calibration_brought_up_to_date(visit: Visit):
    capture_frame(visit, "Check for drift")
    page = visit.page
    check = page.get_by_role("region", name="Drift check", exact=True)
    check.get_by_role("button", name="Check for drift").click()
    verdict = check.get_by_role("status")
    verdict.get_by_text("sensors moved", exact=True).wait_for()
    first = simulated_sensor_models()[0].name
    row = verdict.get_by_role("row", name=re.compile(first))
    row.get_by_text("moved", exact=True).wait_for()
    assert not serious_findings(page)
    # Who leaves finds the verdict again, and what was begun by it.
    visit.screen("Quality")
    visit.screen("Calibrate")
    verdict.get_by_text("sensors moved", exact=True).wait_for()
    check.get_by_role("button", name=f"Bring up to date: {first}").click()
    visit.screen("Quality")
    visit.screen("Calibrate")
    result = page.get_by_role("region", name=re.compile("^Calibration cal-"))
    result.get_by_text(re.compile("^Brought up to date by drift check ")).wait_for()
    result.get_by_role("button", name="Activate").click()
    result.get_by_text("active", exact=True).wait_for()
    # Compared with what is active now, nothing has moved.
    check.get_by_role("button", name="Check for drift").click()
    verdict.get_by_text("good", exact=True).wait_for()
    verdict.get_by_text("Nothing needs to be done.").wait_for()
    assert page.title() == "Calibrate – Lumiline"


@pytest.mark.usefixtures("before_turn")
def test_targets_of_a_former_session_are_taken_again(visit: Visit):
    targets = [{"name": MARKUP, "position_mm": [1, 2, 3], "marker": 4}]
    session = {"id": "former", "device_id": "sim", "targets": targets}
    httpx.post(f"{visit.url}/api/v1/captures", json=session).raise_for_status()
    page = visit.page
    visit.screen("Calibrate")
    page.get_by_label("or the targets of a former session").select_option("former")
    page.get_by_text("1 targets read.").wait_for()
    assert page.get_by_label("Table", exact=True).input_value().endswith(f"{MARKUP}\t1\t2\t3\t4")
    httpx.delete(f"{visit.url}/api/v1/captures/former").raise_for_status()
