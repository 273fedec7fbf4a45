"""A serial device that is unplugged and plugged in again, as the page shows it."""

import re
from collections.abc import Iterator

import httpx
import pytest

from service.api.calibrations.examples import NEW_CALIBRATIONS
from tests.dashboard.conftest import Visit
from tests.hardware.serial.emulated_device import BenchDevice, bench_device

pytestmark = pytest.mark.slow

RATE_HZ = 100.0
ANY = {"If-Match": "*"}


@pytest.fixture
def bar(server: str) -> Iterator[BenchDevice]:
    """A running, calibrated device on a serial port."""
    api = f"{server}/api/v1"
    with bench_device(RATE_HZ, rendered=40) as made:
        source = {"kind": "serial", "settings": {"url": made.url}}
        device = {"id": "bar", "title": "Serial bar", "source": source}
        points = NEW_CALIBRATIONS["frame"]["value"]["points"]
        calibration = {"id": "bar-frame", "device_id": "bar", "points": points}
        try:
            for path, body in (
                ("devices", device),
                ("calibrations", calibration),
                ("calibrations/bar-frame/activate", None),
                ("devices/bar/start", None),
            ):
                httpx.post(f"{api}/{path}", json=body, timeout=60).raise_for_status()
            yield made
        finally:
            httpx.delete(f"{api}/devices/bar?cascade=true", headers=ANY, timeout=60)


def test_unplugged_device_says_why_and_measures_again_once_back(visit: Visit, bar: BenchDevice):
    page = visit.page
    page.get_by_label("Device").select_option("bar")
    points = page.get_by_role("region", name="Points").last.locator("tbody tr")
    points.first.wait_for()
    bar.unplug()
    banner = page.get_by_role("alert").filter(has_text="The device is not running: disconnected.")
    banner.wait_for()
    assert bar.url in banner.inner_text()
    visit.screen("Health")
    devices = page.get_by_role("region", name="Devices and links").last
    row = devices.get_by_role("row", name=re.compile("^bar "))
    row.get_by_text("disconnected", exact=True).first.wait_for()
    assert bar.url in row.locator("td").nth(2).inner_text()
    visit.screen("Scene")
    banner.wait_for()
    bar.plug()
    # Nobody clicks: the server finds the device, and the page its frames.
    banner.wait_for(state="detached")
    points.first.wait_for()
    before = points.first.inner_text()
    points.first.filter(has_not_text=before).wait_for()
    state = httpx.get(f"{visit.url}/api/v1/devices/bar/state").json()
    assert state["state"] == "running"
    assert state["link"]["counters"]["reconnects"] == 1
