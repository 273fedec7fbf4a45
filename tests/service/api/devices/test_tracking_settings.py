"""Tracking settings of a device over REST: set, kept, refused with reasons."""

from typing import Any

import pytest

from compute.tracking.settings import TrackerSettings
from service.api.devices.tracking_settings import Blinking
from tests.service.fake_pipeline import FakePipeline

PATH = "/api/v1/devices/sim"


def test_tracking_settings_patched_are_kept_and_reach_the_tracker(
    client: Any, live: FakePipeline
) -> None:
    client.post(f"{PATH}/start")
    given = {"tracks": "always", "motion": "velocity", "coast_s": 0.5}
    answer = client.patch(PATH, json={"tracking": given})
    assert answer.status_code == 200, answer.text
    assert answer.json()["tracking"].items() >= given.items()
    assert live.tracked["sim"].tracker == TrackerSettings(motion="velocity", coast_s=0.5)
    # What is left out stays.
    client.patch(PATH, json={"tracking": {"motion": "acceleration"}})
    assert live.tracked["sim"].tracker == TrackerSettings(motion="acceleration", coast_s=0.5)


def test_tracking_settings_not_given_are_those_of_the_tracker(
    client: Any, live: FakePipeline
) -> None:
    client.post(f"{PATH}/start")
    client.patch(PATH, json={"tracking": {"tracks": "always"}})
    assert live.tracked["sim"].tracker == TrackerSettings()


@pytest.mark.parametrize(
    ("wrong", "why"),
    [
        ({"motion": "kalman"}, "'velocity', 'acceleration' or 'interacting'"),
        ({"acceleration_psd": 0}, "greater than or equal to 0.001"),
        ({"jerk_psd": -1}, "greater than or equal to 0.001"),
        ({"coast_s": 61}, "less than or equal to 60"),
        ({"method": "window"}, "Extra inputs"),
    ],
)
def test_tracking_settings_out_of_range_or_unknown_are_refused(
    sqlite_client: Any, wrong: dict[str, Any], why: str
) -> None:
    answer = sqlite_client.patch(PATH, json={"tracking": wrong})
    assert answer.status_code == 422
    assert next(iter(wrong)) in answer.text
    assert why in answer.text
    assert sqlite_client.get(PATH).json()["tracking"]["motion"] == "interacting"


def test_the_example_of_blinking_words_is_taken(sqlite_client: Any) -> None:
    words = Blinking.model_fields["words"].examples
    assert words
    for example in words:
        answer = sqlite_client.patch(PATH, json={"tracking": {"blinking": {"words": example}}})
        assert answer.status_code == 200, answer.text
        assert answer.json()["tracking"]["blinking"]["words"] == example
