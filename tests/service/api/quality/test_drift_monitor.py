"""The watch on drift: what it sums up, when it stores it, and what the charts make of it."""

from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np
import pytest

from hardware.simulated.driver import SimulatedDriver
from hardware.simulated.settings import SimulationSettings
from service.api.quality.drift_monitor import DriftMonitor
from service.api.quality.interval_statistics_tap import IntervalStatisticsTap
from service.database.models import WatchSampleRow
from service.problems.errors import NotReady
from tests.service.api.quality.batches import SIGMA_MM, strobed_batch
from tests.service.fake_pipeline import FakePipeline

WATCH = "/api/v1/devices/sim/watch"


def test_the_sums_are_those_of_all_batches() -> None:
    tap = IntervalStatisticsTap(reference=0)
    for first in range(0, 1000, 50):
        tap.offer(strobed_batch(range(first, first + 50), chi2=4.0))
    assert tap.seconds == pytest.approx(0.999)
    (sums,) = tap.take()
    assert (sums.points, sums.checked, sums.inconsistent) == (1000, 1000, 0)
    assert sums.residual_sigma == pytest.approx(2.0)  # one degree of freedom
    assert sums.reference_mm is not None
    assert sums.reference_mm == pytest.approx([-146.0, 0.0, 1500.0], abs=5 * SIGMA_MM / 500**0.5)
    assert sums.reference_scatter_mm == pytest.approx(3**0.5 * SIGMA_MM, rel=0.1)
    assert tap.take() == []


def test_each_calibration_and_table_has_sums_of_its_own() -> None:
    tap = IntervalStatisticsTap(reference=None)
    made_with = [("a", None), ("a", "t"), ("b", None), ("a", None)]
    for place, (calibration, table) in enumerate(made_with):
        tap.offer(strobed_batch(range(10 * place, 10 * place + 10), calibration, table))
    tap.offer(strobed_batch(range(40, 50), calibration=None))
    found = tap.take()
    assert [(sums.calibration_id, sums.table_id) for sums in found] == made_with
    assert [sums.points for sums in found] == [10] * 4
    assert {sums.reference_mm for sums in found} == {None}


@pytest.fixture
def watched(client: Any, live: FakePipeline) -> DriftMonitor:
    """A watch of which only the test takes a look."""
    live.records = SimulatedDriver("sim", SimulationSettings()).description
    live.statuses = lambda: {"sim": live.status("sim")}  # type: ignore[method-assign]
    live.batches = [strobed_batch(range(0, 12_001, 1000))]
    running = live.session("sim")
    live.session = lambda device_id: running  # type: ignore[method-assign]
    return DriftMonitor(client.app.state.database, live)


def test_what_was_seen_is_stored_when_it_is_due(client: Any, watched: DriftMonitor) -> None:
    given = {"interval_s": 10.0, "reference": {"marker": 0}}
    assert client.get(WATCH).json() == {"interval_s": 600.0, "reference": None}
    assert client.put(WATCH, json=given).json() == given
    watched.sample()
    assert client.get("/api/v1/watch-samples").json()["items"] == [], "it has only begun"
    watched.sample()
    (sample,) = client.get("/api/v1/watch-samples?device_id=sim").json()["items"]
    assert (sample["calibration_id"], sample["points"]) == ("sim-nominal", 13)
    assert sample["duration_s"] == pytest.approx(12.0)
    assert sample["reference_mm"] == pytest.approx([-146.0, 0.0, 1500.0], abs=0.1)
    watched.sample()
    assert len(client.get("/api/v1/watch-samples").json()["items"]) == 1, "nothing new was seen"
    # What was seen is nobody's doing, and not in the audit log.
    entries = client.get("/api/v1/audit").json()["items"]
    assert {entry["object_kind"] for entry in entries if "watch" in entry["object_kind"]} == {
        "watch"
    }


def test_at_the_end_what_there_is_is_stored(client: Any, watched: DriftMonitor) -> None:
    watched.sample()
    watched.sample()
    assert client.get("/api/v1/watch-samples").json()["items"] == []
    watched.close()  # its thread never ran
    watched.sample(last=True)
    assert len(client.get("/api/v1/watch-samples").json()["items"]) == 1


def test_a_deleted_device_takes_its_history_with_it(client: Any, watched: DriftMonitor) -> None:
    client.put(WATCH, json={"interval_s": 10.0}).raise_for_status()
    watched.sample()
    watched.sample()
    assert len(client.get("/api/v1/watch-samples").json()["items"]) == 1
    assert client.delete("/api/v1/devices/sim?cascade=true").is_success
    assert client.get("/api/v1/watch-samples").json()["items"] == []
    watched.sample(last=True)


def store(client: Any, residuals: Any, reference_x: Any) -> None:
    begin = datetime.now(UTC) - timedelta(hours=2)
    with client.app.state.database.write() as session:
        for index, (residual, x) in enumerate(zip(residuals, reference_x, strict=True)):
            session.add(
                WatchSampleRow(
                    device_id="sim",
                    calibration_id="sim-nominal",
                    table_id=None,
                    at=begin + timedelta(minutes=index),
                    seconds=60.0,
                    points=1000,
                    residual_sigma=float(residual),
                    inconsistent=0,
                    reference_mm=[float(x), 0.0, 1500.0],
                    reference_scatter_mm=0.03,
                    temperature_c=21.5 + 0.1 * index,
                )
            )


def noise(count: int, seed: int, scale: float) -> Any:
    return np.random.default_rng(seed).normal(0.0, scale, count)


def advice(client: Any) -> tuple[str, str]:
    found = client.get("/api/v1/devices/sim/quality").json()
    return found["recommendation"], "; ".join(found["reasons"])


def test_a_device_that_stays_as_it_was_needs_nothing(sqlite_client: Any) -> None:
    store(sqlite_client, 1 + noise(25, 1, 0.01), noise(25, 2, 0.005))
    assert advice(sqlite_client) == ("none", "")
    found = sqlite_client.get("/api/v1/devices/sim/quality").json()
    assert [chart["series"] for chart in found["charts"]] == [
        "residual", "reference-x", "reference-y", "reference-z", "temperature",
    ]  # fmt: skip
    assert all(chart["ready"] for chart in found["charts"])
    # It grew warmer, which is told and is no reason.
    assert found["charts"][4]["points"][-1]["signal"] != "none"


def test_a_marker_that_moved_once_is_to_be_checked_and_for_good_to_be_calibrated(
    sqlite_client: Any,
) -> None:
    quiet = noise(25, 2, 0.005)
    once = quiet.copy()
    once[-1] += 0.1
    store(sqlite_client, np.ones(25), once)
    verdict, reasons = advice(sqlite_client)
    assert verdict == "check"
    assert "reference-x shows a jump: 0.09" in reasons
    # The charts' times are all of the last two hours; these are stored last, and so the newest.
    store(sqlite_client, np.ones(2), [0.1, 0.1])
    verdict, reasons = advice(sqlite_client)
    assert verdict == "recalibrate"
    assert "reference-x stays changed" in reasons


@pytest.mark.slow
def test_what_is_normal_is_not_forgotten(sqlite_client: Any) -> None:
    """The first values say it, however many come after a change."""
    quiet = noise(120, 4, 0.005)
    store(sqlite_client, np.ones(120), quiet)
    store(sqlite_client, np.ones(1000), noise(1000, 5, 0.005) + 0.5)
    verdict, reasons = advice(sqlite_client)
    assert verdict == "recalibrate"
    assert (
        "reference-x stays changed: 0.5" in reasons or "reference-x stays changed: 0.49" in reasons
    )
    (chart,) = [
        one
        for one in sqlite_client.get("/api/v1/devices/sim/quality").json()["charts"]
        if one["series"] == "reference-x"
    ]
    assert chart["centre"] == pytest.approx(0.0, abs=0.005)
    assert len(chart["points"]) == 1000


def test_what_could_not_be_stored_is_stored_later(
    client: Any, watched: DriftMonitor, monkeypatch: pytest.MonkeyPatch
) -> None:
    client.put(WATCH, json={"interval_s": 10.0}).raise_for_status()
    watched.sample()
    database = client.app.state.database
    with monkeypatch.context() as patch:
        patch.setattr(database, "write", raising(NotReady("locked", part="database")))
        watched.sample()
    watched.sample(last=True)
    assert len(client.get("/api/v1/watch-samples").json()["items"]) == 1


def raising(error: Exception) -> Any:
    def fail() -> None:
        raise error

    return fail


def test_little_is_known_at_first(sqlite_client: Any) -> None:
    assert advice(sqlite_client)[0] == "observe"
    store(sqlite_client, np.ones(3), np.zeros(3))
    verdict, reasons = advice(sqlite_client)
    assert verdict == "observe"
    assert "3 of 20 values" in reasons


@pytest.mark.slow
def test_the_picture_is_one(sqlite_client: Any) -> None:
    url = "/api/v1/devices/sim/quality.png"
    empty = sqlite_client.get(url)
    store(sqlite_client, 1 + noise(30, 1, 0.01), noise(30, 2, 0.005))
    full = sqlite_client.get(url)
    for answer in (empty, full):
        assert answer.headers["content-type"] == "image/png"
        assert answer.content.startswith(b"\x89PNG")
    assert len(full.content) > 2 * len(empty.content)
