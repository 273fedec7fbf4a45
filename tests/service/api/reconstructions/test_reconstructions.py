"""Reconstructions: points from posted readings, stored, read, deleted; on both databases."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hardware.simulated.calibration_target import calibration_target_points_mm
from service.api.calibrations.examples import simulated_points
from tests.service.fake_pipeline import TestClient

URL = "/api/v1/reconstructions"
OFFSETS = [[0, 0, 0], [140, -60, 200], [-90, 75, -300]]


def points(sigma_px: float | None = None) -> list[dict[str, Any]]:
    return [
        {
            "name": point["name"],
            "readings": {
                sensor: value if sigma_px is None else {"position_px": value, "sigma_px": sigma_px}
                for sensor, value in point["readings"].items()
            },
        }
        for point in simulated_points(OFFSETS)
    ]


def test_points_come_back_where_they_were(client: Any):
    made = client.post(URL, json={"device_id": "sim", "points": points(0.003)})
    assert made.status_code == 201
    document = made.json()
    assert client.get(made.headers["location"]).json() == document
    assert document["calibration_id"] == "sim-nominal"
    assert [item["name"] for item in document["estimates"]] == ["P1", "P2", "P3"]
    for estimate, offset in zip(document["estimates"], OFFSETS, strict=True):
        error = np.array(estimate["position_mm"]) - np.array([0, 0, 1500]) - offset
        covariance = np.array(estimate["covariance_mm2"])
        # Readings are rounded to 0.01 px, a deviation of 0.003 px: 3 degrees of freedom.
        assert error @ np.linalg.solve(covariance, error) < 25
        assert len(estimate["sensors"]) == 4


def test_deviations_scale_the_covariance(client: Any):
    def covariance(sigma_px: float) -> Any:
        made = client.post(URL, json={"device_id": "sim", "points": points(sigma_px)}).json()
        return np.array(made["estimates"][1]["covariance_mm2"])

    assert covariance(1.0) == pytest.approx(4 * covariance(0.5), rel=1e-3)


def test_three_sensors_say_that_there_is_no_redundancy_and_two_make_no_point(client: Any):
    given = points()
    del given[0]["readings"]["vertical"]
    del given[1]["readings"]["vertical"], given[1]["readings"]["horizontal"]
    given[2]["readings"] = {}
    made = client.post(URL, json={"device_id": "sim", "points": given}).json()
    three, two, none = made["estimates"]
    assert three["flags"] == ["no-redundancy"]
    assert three["position_mm"] is not None
    assert three["residual_sigma"] is None
    for missing in (two, none):
        assert missing["flags"] == ["too-few-sensors"]
        assert missing["position_mm"] is None
        assert missing["covariance_mm2"] is None


@pytest.mark.slow
def test_reliability_says_what_four_sensors_check_and_three_do_not(client: Any):
    given = points(0.05)
    given[1]["readings"]["horizontal"]["position_px"] += 40.0
    del given[2]["readings"]["vertical"]
    made = client.post(URL, json={"device_id": "sim", "points": given}).json()
    four, wrong, three = made["estimates"]
    assert set(four["detectable_px"]) == set(four["sensors"])
    assert all(value > 0.05 for value in four["detectable_px"].values())
    assert four["external_reliability_mm"] > 0.0
    assert wrong["flags"] == ["inconsistent", "not-identifiable"]
    assert wrong["excluded"] == []
    assert set(three["detectable_px"].values()) == {None}
    assert three["external_reliability_mm"] is None


@pytest.mark.slow
def test_the_active_calibration_is_used_unless_one_is_named(client: Any):
    frame = 2.0 * calibration_target_points_mm()[::2]
    for name in ("first", "second"):
        client.post(
            "/api/v1/calibrations",
            json={"id": name, "device_id": "sim", "points": simulated_points(frame)},
        )
    client.post("/api/v1/calibrations/first/activate")

    def used(**named: str) -> str:
        made = client.post(URL, json={"device_id": "sim", "points": points()} | named)
        return str(made.json()["calibration_id"])

    assert used() == "first"
    assert used(calibration_id="second") == "second"
    client.post("/api/v1/calibrations/second/retire")
    refused = client.post(
        URL, json={"device_id": "sim", "points": points(), "calibration_id": "second"}
    )
    assert (refused.status_code, refused.json()["type"]) == (409, "/problems/calibration-retired")


def test_list_and_delete(client: Any):
    for name in ("one", "two"):
        client.post(URL, json={"id": name, "device_id": "sim", "points": points()})
    page = client.get(f"{URL}?device_id=sim").json()
    assert [(item["id"], item["point_count"]) for item in page["items"]] == [("two", 3), ("one", 3)]
    assert client.get(f"{URL}?device_id=other").json()["items"] == []
    assert client.delete(f"{URL}/one").status_code == 204
    assert client.get(f"{URL}/one").status_code == 404
    assert client.delete(f"{URL}/one").status_code == 404
    assert len(client.get(URL).json()["items"]) == 1


def test_an_id_is_unique(client: Any):
    body = {"id": "one", "device_id": "sim", "points": points()}
    assert client.post(URL, json=body).status_code == 201
    refused = client.post(URL, json=body)
    assert (refused.status_code, refused.json()["type"]) == (409, "/problems/reconstruction-exists")


@pytest.mark.slow
def test_differences_are_reconstructed_minus_given(sqlite_client: TestClient) -> None:
    """The published sign, and the same reconstruction as for posted readings."""
    examples = Path(__file__).parents[4] / "docs" / "examples"
    device, frame = (
        json.loads((examples / f"{name}.json").read_text(encoding="utf-8"))
        for name in ("device", "calibration")
    )
    assert sqlite_client.post("/api/v1/devices", json=device).status_code == 201
    made = sqlite_client.post("/api/v1/calibrations", json=frame).json()
    points = [{"name": p["name"], "readings": p["readings"]} for p in frame["points"]]
    body = {"device_id": device["id"], "calibration_id": made["id"], "points": points}
    estimates = sqlite_client.post("/api/v1/reconstructions", json=body).json()["estimates"]
    for given, estimate, difference in zip(
        frame["points"], estimates, made["errors"]["fitted"]["differences_mm"], strict=True
    ):
        found = np.subtract(estimate["position_mm"], given["position_mm"])
        assert np.allclose(found, difference, atol=1e-6)
