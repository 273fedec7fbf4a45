"""The wand in the wizard: from a device without any calibration to an active one, by clicks."""

import re
from collections.abc import Iterator

import httpx
import numpy as np
import pytest
from pydantic import TypeAdapter

from compute.calibration.result import Calibration
from compute.camera.stack import CameraStack
from compute.reconstruction.triangulation import reconstruct
from hardware.simulated.simulated_rig import simulated_sensor_models
from tests.dashboard.conftest import Visit
from tests.dashboard.test_pages import ANY, serious_findings

pytestmark = pytest.mark.slow

LENGTH_MM = 300.0
DIRECTIONS = {
    "vertical": "90",
    "horizontal": "0",
    "diagonal-rising": "45",
    "diagonal-falling": "-45",
}
"""Of the simulated sensors' pixels, seen from the device."""


@pytest.fixture
def bench(visit: Visit) -> Iterator[str]:
    """A simulated device without any calibration, whose bar turns; the page shows it."""
    devices = f"{visit.url}/api/v1/devices"
    source = {"kind": "simulated", "settings": {"frame_rate_hz": 200}}
    body = {"id": "bench", "title": "Bench", "source": source}
    httpx.post(f"{devices}/sim/stop", timeout=60).raise_for_status()
    httpx.post(devices, json=body, timeout=60).raise_for_status()
    httpx.post(f"{devices}/bench/start", timeout=60).raise_for_status()
    visit.page.get_by_role("option", name="Bench").wait_for(state="attached")
    visit.page.locator(".top select").select_option("bench")
    yield "bench"
    httpx.delete(f"{devices}/bench?cascade=true", headers=ANY, timeout=60).raise_for_status()
    httpx.post(f"{devices}/sim/start", timeout=60)


def lengths_mm(calibration: dict[str, object]) -> np.ndarray:
    """Lengths of bars anywhere in the volume, as the cameras measure them without noise."""
    models = TypeAdapter(Calibration).validate_python(calibration["result"]).models
    rng = np.random.default_rng(1)
    along = rng.standard_normal((50, 3))
    along *= 0.5 * LENGTH_MM / np.linalg.norm(along, axis=1, keepdims=True)
    middle = np.array([0.0, 0.0, 1500.0]) + rng.uniform(-150.0, 150.0, (50, 3))
    ends = np.concatenate([middle - along, middle + along])
    readings = CameraStack.of(simulated_sensor_models()).project(ends)
    found = reconstruct(models, readings, np.full(4, 0.01)).position_mm
    return np.linalg.norm(found[:50] - found[50:], axis=1)


@pytest.mark.parametrize("scheme", ["dark"])
def test_a_device_without_calibration_is_calibrated_by_a_wand(
    visit: Visit, bench: str, scheme: str
):
    page = visit.page
    visit.screen("Calibrate")
    page.get_by_text("The device has no calibration.").wait_for()
    page.get_by_label("Calibrate by a wand").check()
    wand = page.get_by_role("region", name="Wand", exact=True)
    wand.get_by_label("Their strobe numbers").fill("0")
    wand.get_by_text("There are 2 markers and 1 strobe numbers").wait_for()
    assert wand.get_by_role("button", name="New capture").is_disabled()
    wand.get_by_label("Their strobe numbers").fill("0, 1")
    wand.get_by_role("button", name="Let the simulated device wave it").click()
    wand.get_by_role("button", name="Let the simulated device wave it").wait_for()
    wand.get_by_role("button", name="New capture").click()
    page.get_by_text("READY", exact=True).wait_for()
    capture = page.get_by_role("region", name=re.compile("^Capture wave-capture"))
    capture.get_by_role("button", name="Start", exact=True).click()
    page.get_by_text("WAVE", exact=True).wait_for()
    page.get_by_role("heading", name="Missing").wait_for()
    page.get_by_text("ENOUGH", exact=True).wait_for()
    page.get_by_text("Ended: enough.").wait_for()
    coverage = page.get_by_role("region", name="Coverage of the sensors").last
    coverage.get_by_role("img", name=re.compile("% of the pixels covered")).first.wait_for()
    disc = page.get_by_role("img", name=re.compile(r"Wand held in 1[0-3] of 13 directions"))
    disc.wait_for()
    for colours in ("light", scheme):
        page.emulate_media(color_scheme=colours)
        assert not serious_findings(page)
    for name, degrees in DIRECTIONS.items():
        page.get_by_role("group", name=re.compile("^Direction of each")).get_by_label(name).fill(
            degrees
        )
    page.get_by_role("button", name="Compute the calibration").click()
    page.get_by_text("at poses held out: what a new length will have").wait_for()
    result = page.get_by_role("region", name=re.compile("^Calibration "))
    assert result.get_by_role("alert").count() == 0
    page.get_by_role("button", name="Activate").click()
    result.get_by_text("active", exact=True).wait_for()
    device = httpx.get(f"{visit.url}/api/v1/devices/{bench}").json()
    found = httpx.get(f"{visit.url}/api/v1/calibrations/{device['active_calibration_id']}").json()
    assert found["provenance"] == "self-calibrated"
    assert found["note"] == ""
    assert found["errors"]["lengths_left_out"]["rms_mm"] < 1.0
    assert np.abs(lengths_mm(found) - LENGTH_MM).max() < 1.5
    visit.screen("Scene")
    page.get_by_role("region", name="Points").locator("tbody tr").first.wait_for()


def test_a_wand_is_waved_by_keyboard(visit: Visit, bench: str):
    """Stopped early it says what is missing; it goes on, and is deleted after a question."""
    page = visit.page
    visit.screen("Calibrate")
    page.get_by_label("Calibrate by points at known positions").focus()
    page.keyboard.press("ArrowDown")
    assert page.get_by_label("Calibrate by a wand").is_checked()

    def press(name: str) -> None:
        page.get_by_role("button", name=name, exact=True).focus()
        page.keyboard.press("Enter")

    press("New capture")
    press("Start")
    page.get_by_text("WAVE", exact=True).wait_for()
    press("Stop")
    page.get_by_text("STOPPED", exact=True).wait_for()
    page.get_by_text("Ended: stopped.").wait_for()
    page.get_by_text(re.compile("more poses of the 100 that are wanted")).wait_for()
    # The bar turns in a plane: there is never enough.
    press("Start again for more poses")
    page.get_by_text("WAVE", exact=True).wait_for()
    press("Delete")
    press("Yes")
    page.get_by_role("button", name="New capture").wait_for()
    page.get_by_text("There are no capture sessions of this device.").wait_for()
