"""What Health shows of a running device and of the processes."""

import re

import pytest

from tests.dashboard.conftest import Visit
from tests.dashboard.test_pages import serious_findings, show

pytestmark = pytest.mark.slow


def test_health_of_a_running_device_shows_stages_losses_and_processes(visit: Visit):
    show(visit.url, {"kind": "rotating-bar"})
    page = visit.page
    visit.screen("Health")
    waterfall = page.get_by_role("region", name="Latency of sim by stage")
    rows = waterfall.locator("tbody tr")
    rows.first.wait_for()
    stages = [row.partition(":")[0] for row in rows.all_inner_texts()]
    assert [stage.split()[0] for stage in stages] == [
        *("reception", "waiting", "computation", "publication")
    ]
    computation = waterfall.get_by_role("row", name=re.compile("computation: peaks to poses"))
    assert re.search(r"\d ms", computation.inner_text())
    bars = rows.locator(".waterfall > span")
    left = [bar.bounding_box()["x"] for bar in bars.all()]  # type: ignore[index]
    assert left == sorted(left)
    assert left[0] < left[-1]
    losses = page.get_by_role("region", name="Losses by place").last.get_by_role("row", name="sim")
    counts = [cell.split() for cell in losses.locator("td").all_inner_texts()]
    # A simulated device has no cable; of all else there is a number.
    assert all(one[0].isdigit() for one in counts[3:6])
    processes = page.get_by_role("region", name="Processes").last
    for name, note in (("Gateway", "open files"), ("Station", "never lost")):
        row = processes.get_by_role("row", name=re.compile(name)).inner_text()
        assert note in row
        assert re.search(r"\d [MG]B", row)
    assert not serious_findings(page)
