"""Labels that look wrong, judged by a person; the device is calibrated again from what is left."""

import copy
import re
import time
from typing import Any

import httpx
import pytest

from service.api.calibrations.examples import NEW_CALIBRATIONS
from tests.dashboard.conftest import Visit
from tests.dashboard.test_pages import serious_findings

pytestmark = pytest.mark.slow

MARKUP = "<img src=x onerror=\"document.title='broken'\">"


def wrong_points() -> list[dict[str, Any]]:
    """Return the frame's points: two exchanged in all sensors, one reading wrong by 30 px."""
    points: list[dict[str, Any]] = copy.deepcopy(NEW_CALIBRATIONS["frame"]["value"]["points"])
    points[3]["name"] = MARKUP
    points[3]["readings"], points[11]["readings"] = points[11]["readings"], points[3]["readings"]
    sensor = next(iter(points[7]["readings"]))
    points[7]["readings"][sensor] += 30.0
    return points


def calibrate(server: str, points: list[dict[str, Any]], name: str) -> None:
    """Calibrate the simulated device by a run."""
    body = {"id": f"run-{name}", "device_id": "sim", "result_id": name, "points": points}
    runs = httpx.post(f"{server}/api/v1/runs/calibration", json=body, timeout=60)
    runs.raise_for_status()
    while (run := httpx.get(f"{server}/api/v1/runs/run-{name}").json())["state"] != "succeeded":
        assert run["state"] in ("queued", "running"), run
        time.sleep(0.2)


def test_labels_are_judged_and_the_device_calibrated_again(visit: Visit):
    calibrate(visit.url, wrong_points(), "wrong-labels")
    page = visit.page
    visit.screen("Calibrate")
    page.get_by_role("button", name="wrong-labels", exact=True).click()
    result = page.get_by_role("region", name="Calibration wrong-labels", exact=True)
    labels = result.get_by_role("region", name="Readings and labels that look wrong")
    exchange = labels.get_by_role("row", name=re.compile("All sensors: the readings of"))
    assert MARKUP in exchange.inner_text()
    assert result.get_by_role("button", name="Calibrate again").is_disabled()
    exchange.get_by_role("combobox").select_option("exchange back")
    outlier = labels.get_by_role("row", name=re.compile("fits neither this point"))
    outlier.get_by_role("combobox").select_option("leave it out")
    result.get_by_role("button", name="Calibrate again").click()
    beside = result.get_by_role("region", name="Beside the former calibration")
    untouched = beside.get_by_role("row", name=re.compile("the 1[56] points not touched"))
    untouched.wait_for()
    former, now = (largest(cell) for cell in untouched.locator("td").all_inner_texts()[1:])
    assert now < 1.0 < former
    assert "Left out one by one: mean error" in beside.locator("tbody tr").first.inner_text()
    assert not serious_findings(page)
    result.get_by_role("button", name=re.compile("^Show calibration cal-")).click()
    page.get_by_text("No reading and no label looks wrong.").wait_for()
    page.get_by_text(re.compile("^wrong-labels again, with labels judged: ")).wait_for()
    assert page.title() == "Calibrate – Lumiline"
    newest = httpx.get(f"{visit.url}/api/v1/calibrations?device_id=sim&limit=1").json()["items"][0]
    points = httpx.get(f"{visit.url}/api/v1/calibrations/{newest['id']}").json()["points"]
    right: list[dict[str, Any]] = copy.deepcopy(NEW_CALIBRATIONS["frame"]["value"]["points"])
    right[3]["name"] = MARKUP
    assert len(right[7]["readings"]) - len(points[7]["readings"]) == 1
    del right[7], points[7]
    assert points == right


def largest(cell: str) -> float:
    """Return the largest number of a cell."""
    return max(float(number) for number in cell.split(", "))
