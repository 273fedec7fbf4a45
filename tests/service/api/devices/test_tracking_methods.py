"""A device's method of tracking over REST: set, kept, refused with reasons."""

from typing import Any

import pytest

from compute.tracking.settings import TrackerSettings
from compute.tracking.thesis.settings import ThesisSettings
from service.api.devices.tracking_settings import Blinking
from tests.service.api.devices.test_devices import EXTERNAL
from tests.service.fake_pipeline import FakePipeline

PATH = "/api/v1/devices/sim"


def test_the_method_is_a_setting_that_stays(client: Any, live: FakePipeline) -> None:
    assert client.get(PATH).json()["tracking"]["method"] == "readings"
    client.post(f"{PATH}/start")
    given = {"tracks": "always", "method": "window", "velocity_limit_px_s": 300.0, "coast_s": 0.5}
    answer = client.patch(PATH, json={"tracking": given})
    assert answer.status_code == 200, answer.text
    assert answer.json()["tracking"].items() >= given.items()
    expected = ThesisSettings("window", velocity_limit_px_s=300.0, coast_s=0.5)
    assert live.tracked["sim"].tracker == expected
    # What is left out stays; of another method too.
    client.patch(PATH, json={"tracking": {"method": "probabilistic", "min_interval_px": 4.0}})
    now = ThesisSettings(
        "probabilistic", velocity_limit_px_s=300.0, min_interval_px=4.0, coast_s=0.5
    )
    assert live.tracked["sim"].tracker == now
    client.patch(PATH, json={"tracking": {"method": "readings"}})
    assert live.tracked["sim"].tracker == TrackerSettings(coast_s=0.5)


def test_a_change_without_a_method_is_as_before(client: Any, live: FakePipeline) -> None:
    client.post(f"{PATH}/start")
    client.patch(PATH, json={"tracking": {"tracks": "always"}})
    assert live.tracked["sim"].tracker == TrackerSettings()


@pytest.mark.parametrize(
    ("wrong", "why"),
    [
        ({"method": "kalman"}, "'readings'"),
        ({"window_markers": 3}, "less than or equal to 2"),
        ({"window_points": 2}, "greater than or equal to 3"),
        ({"window_decision": "nearest"}, "'velocity' or 'prediction'"),
        ({"interval_velocity": "last"}, "'mean' or 'curve'"),
        ({"max_velocity_px_s": 0}, "greater than or equal to 0.001"),
        ({"velocity_limit_px_s": -1}, "greater than or equal to 0.001"),
        ({"min_interval_px": 0}, "greater than or equal to 0.001"),
        ({"swap_threshold": 1}, "less than 1"),
        ({"window": 7}, "Extra inputs"),
    ],
)
def test_settings_that_cannot_be_are_refused(
    sqlite_client: Any, wrong: dict[str, Any], why: str
) -> None:
    answer = sqlite_client.patch(PATH, json={"tracking": wrong})
    assert answer.status_code == 422
    assert next(iter(wrong)) in answer.text
    assert why in answer.text
    assert sqlite_client.get(PATH).json()["tracking"]["method"] == "readings"


def test_two_sensors_are_too_few_for_points_of_tracks(sqlite_client: Any) -> None:
    source = EXTERNAL["source"] | {"sensors": EXTERNAL["source"]["sensors"][:2]}
    two = EXTERNAL | {"source": source}
    refused = sqlite_client.post("/api/v1/devices", json=two | {"tracking": {"method": "window"}})
    assert (refused.status_code, refused.json()["type"]) == (422, "/problems/invalid-parameter")
    assert "2 sensors" in refused.json()["detail"]
    assert sqlite_client.post("/api/v1/devices", json=two).status_code == 201
    path = "/api/v1/devices/bar"
    later = sqlite_client.patch(path, json={"tracking": {"method": "eight-state"}})
    assert later.status_code == 422
    assert sqlite_client.get(path).json()["tracking"]["method"] == "readings"


def test_the_example_of_blinking_words_is_taken(sqlite_client: Any) -> None:
    words = Blinking.model_fields["words"].examples
    assert words
    for example in words:
        answer = sqlite_client.patch(PATH, json={"tracking": {"blinking": {"words": example}}})
        assert answer.status_code == 200, answer.text
        assert answer.json()["tracking"]["blinking"]["words"] == example
