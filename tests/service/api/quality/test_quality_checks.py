"""Quality checks over HTTP: what is measured is told and kept, what cannot be is refused."""

from typing import Any

import pytest

from hardware.simulated.driver import SimulatedDriver
from hardware.simulated.settings import SimulationSettings
from tests.service.api.quality.batches import LENGTH_MM, SIGMA_MM, strobed_batch
from tests.service.fake_pipeline import FakePipeline

URL = "/api/v1/devices/sim/quality-checks"
BAR = {"kind": "point-to-point", "markers": [0, 1], "reference_mm": LENGTH_MM, "duration_s": 0.5}
STILL = {"kind": "single-point", "marker": 0, "duration_s": 0.5}


@pytest.fixture
def live() -> FakePipeline:
    found = FakePipeline()
    found.records = SimulatedDriver("sim", SimulationSettings()).description
    found.batches = [strobed_batch(range(first, first + 100)) for first in range(0, 1000, 100)]
    return found


@pytest.mark.slow
def test_a_known_distance(client: Any) -> None:
    answer = client.post(URL, json=BAR | {"id": "bar", "tolerance_mm": 0.1, "note": "cold"})
    assert answer.status_code == 201, answer.text
    assert answer.headers["location"] == "/api/v1/quality-checks/bar"
    made = answer.json()
    assert (made["device_id"], made["calibration_id"], made["table_id"]) == (
        "sim", "sim-nominal", None,
    )  # fmt: skip
    assert (made["passed"], made["points"], made["note"]) == (True, 499, "cold")
    # Interpolation between two positions halves the variance of one end.
    assert made["result"]["errors"]["rms"] == pytest.approx(1.5**0.5 * SIGMA_MM, rel=0.1)
    assert made["result"]["normalised_square"] == pytest.approx(1.0, abs=0.2)
    assert made["asked"]["reference_mm"] == LENGTH_MM
    assert client.get("/api/v1/quality-checks/bar").json() == made
    assert client.get("/api/v1/quality-checks?device_id=sim").json()["items"] == [made]
    assert client.get("/api/v1/quality-checks?kind=single-point").json()["items"] == []
    audited = client.get("/api/v1/audit?object_id=bar").json()["items"]
    assert [entry["operation"] for entry in audited] == ["create-quality-check"]


def test_a_tolerance_that_is_not_met(sqlite_client: Any) -> None:
    wrong = sqlite_client.post(URL, json=BAR | {"reference_mm": 290.0, "tolerance_mm": 1.0}).json()
    assert wrong["passed"] is False
    assert wrong["result"]["errors"]["mean"] == pytest.approx(2.0, abs=0.01)
    found = sqlite_client.get("/api/v1/devices/sim/quality").json()
    assert found["recommendation"] == "recalibrate"
    assert "not within 1 mm" in found["reasons"][0]


@pytest.mark.slow
def test_a_check_with_a_wrong_reference_is_not_the_last_word(sqlite_client: Any) -> None:
    wrong = BAR | {"reference_mm": 229.0, "tolerance_mm": 0.5}
    for right_follows in (False, True):
        sqlite_client.post(URL, json=wrong | {"id": "typo"}).raise_for_status()
        assert advice(sqlite_client) == "recalibrate"
        if right_follows:
            sqlite_client.post(URL, json=BAR | {"tolerance_mm": 0.5}).raise_for_status()
        else:
            assert sqlite_client.delete("/api/v1/quality-checks/typo").status_code == 204
        assert advice(sqlite_client) == "observe"
    assert sqlite_client.delete("/api/v1/quality-checks/none").status_code == 404


def advice(client: Any) -> str:
    found: str = client.get("/api/v1/devices/sim/quality").json()["recommendation"]
    return found


def test_a_still_marker(sqlite_client: Any) -> None:
    made = sqlite_client.post(URL, json=STILL).json()
    assert made["result"]["scatter"]["rms"] == pytest.approx(3**0.5 * SIGMA_MM, rel=0.1)
    assert made["result"]["bias"] is None
    assert made["passed"] is None
    place = {"reference_position_mm": [-146.0, 3.0, 1504.0], "tolerance_mm": 5.0}
    made = sqlite_client.post(URL, json=STILL | place).json()
    assert made["result"]["bias"] == pytest.approx(5.0, abs=0.01)
    assert made["passed"] is False


@pytest.mark.slow
def test_markers_that_are_lit_together(sqlite_client: Any, live: FakePipeline) -> None:
    live.records = SimulatedDriver(
        "sim", SimulationSettings(illumination="simultaneous")
    ).description
    live.batches = [strobed_batch(range(200), lit_together=True)]
    made = sqlite_client.post(URL, json=BAR | {"markers": None}).json()
    assert (made["points"], made["left_out"]) == (200, 0)
    assert made["result"]["errors"]["rms"] == pytest.approx(2**0.5 * SIGMA_MM, rel=0.15)
    # A single marker cannot be told from two.
    answer = sqlite_client.post(URL, json=STILL | {"marker": None})
    assert answer.json()["type"] == "/problems/too-few-points"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "status", "kind", "words"),
    [
        ({"markers": [0, 2]}, 422, "invalid-parameter", "no strobed marker 2; it has 0 to 1"),
        ({"markers": [1, 1]}, 422, "invalid-request", "marker 1 twice"),
        ({"markers": None}, 422, "invalid-parameter", "strobes 2 markers"),
        ({"reference_mm": 0.0}, 422, "invalid-request", "greater than 0"),
        ({"duration_s": 61.0}, 422, "invalid-request", "less than or equal to 60"),
        ({"kind": "three-points"}, 422, "invalid-request", "three-points"),
        ({"id": "taken"}, 409, "quality-check-exists", '"taken"'),
    ],
)
def test_what_is_refused(
    sqlite_client: Any, change: dict[str, Any], status: int, kind: str, words: str
) -> None:
    sqlite_client.post(URL, json=STILL | {"id": "taken"}).raise_for_status()
    answer = sqlite_client.post(URL, json=BAR | change)
    assert (answer.status_code, answer.json()["type"]) == (status, f"/problems/{kind}")
    assert words in answer.text
    assert len(sqlite_client.get("/api/v1/quality-checks").json()["items"]) == 1


@pytest.mark.parametrize(
    ("batches", "status", "kind"),
    [
        ([strobed_batch(range(1))], 422, "too-few-points"),
        ([strobed_batch(range(9), calibration=None)], 409, "no-active-calibration"),
        (
            [strobed_batch(range(9)), strobed_batch(range(9, 19), calibration="b")],
            409,
            "calibration-switched",
        ),
        (
            [strobed_batch(range(9)), strobed_batch(range(9, 19), table="t")],
            409,
            "calibration-switched",
        ),
    ],
)
def test_what_cannot_be_measured(
    sqlite_client: Any, live: FakePipeline, batches: list[Any], status: int, kind: str
) -> None:
    live.batches = batches
    answer = sqlite_client.post(URL, json=BAR)
    assert (answer.status_code, answer.json()["type"]) == (status, f"/problems/{kind}")
    assert live.calls[-1] == ("detach", "sim")
    assert sqlite_client.get("/api/v1/quality-checks").json()["items"] == []


def test_a_device_that_does_not_run(sqlite_client: Any, live: FakePipeline) -> None:
    live.records = None
    assert sqlite_client.post(URL, json=BAR).json()["type"] == "/problems/device-not-running"
    answer = sqlite_client.post("/api/v1/devices/no/quality-checks", json=BAR)
    assert answer.json()["type"] == "/problems/unknown-device"
    answer = sqlite_client.get("/api/v1/quality-checks/no")
    assert answer.json()["type"] == "/problems/unknown-quality-check"
