"""Blinking markers through the live path: simulated lines to named tracks; settings by REST."""

from itertools import islice

import numpy as np
import pytest
from fastapi.testclient import TestClient

from compute.tracking.blink_codes import blink_codes
from hardware.blink_schedule import BlinkSchedule
from hardware.simulated.driver import SimulatedDriver
from hardware.simulated.scenes import MovingTool, MovingTools
from hardware.simulated.settings import SimulationSettings
from service.api.devices.tracking_settings import Blinking
from service.pipeline.active_calibration import ActiveCalibration
from service.pipeline.frame_processor import FrameProcessor
from service.pipeline.tracking_config import TrackingConfig
from tests.service.pipeline.test_pipeline_manager import nominal

CODES = blink_codes(3, 12, 3)
SCENE = MovingTools(
    (MovingTool(((0.0, 0.0, 0.0), (60.0, 0.0, 0.0), (0.0, 80.0, 10.0)), turn_rad=(0.1, 0.1, 0.1)),)
)
SETTINGS = SimulationSettings(
    SCENE,
    frame_rate_hz=400.0,
    illumination="simultaneous",
    blink=BlinkSchedule(CODES.words, 0.4, (0, 3, 7)),
    realtime=False,
)


def test_tracks_of_blinking_markers_have_their_numbers() -> None:
    driver = SimulatedDriver("sim", SETTINGS)
    driver.open()
    processor = FrameProcessor("sim", driver.description, "cpu")
    processor.set_calibration(ActiveCalibration("c1", nominal()))
    codes = Blinking(words=list(CODES.words)).codes()
    processor.set_tracking_config(TrackingConfig(tracks=True, blinking=codes))
    frames = list(islice(driver.frames(), 48))
    motion = None
    for first in range(0, 48, 8):
        motion = processor.process(frames[first : first + 8]).motion
    assert motion is not None
    last = motion.tracks.identity.size - 3
    named = dict(
        zip(motion.tracks.marker[last:].tolist(), motion.tracks.position_mm[last:], strict=True)
    )
    true = SCENE.points(SETTINGS.timing.time_s(np.array([47])))[0]
    assert sorted(named) == [0, 1, 2]
    for marker, place in named.items():
        assert np.linalg.norm(place - true[marker]) < 1.0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("blinking", "said"),
    [
        ({"words": ["000000010111", "000000010110"]}, "must be at least 3"),
        ({"words": ["0101010101"]}, "must be at least 3"),
        ({"words": ["000000010111", "0000000101"]}, "lengths"),
        ({"words": ["000000010111"], "off_level": 0.0}, "0.05"),
        ({"words": ["00000001011x"]}, "pattern"),
        ({"words": []}, "at least 1 item"),
    ],
)
def test_codes_that_cannot_be_told_are_refused(
    client: TestClient, blinking: dict[str, object], said: str
) -> None:
    change = {"tracking": {"blinking": blinking}}
    answer = client.patch("/api/v1/devices/sim", json=change)
    assert answer.status_code == 422
    assert said in answer.text


def test_codes_are_kept_and_taken_away(client: TestClient) -> None:
    words = list(CODES.words)
    change = {"tracking": {"blinking": {"words": words, "off_level": 0.3}}}
    kept = client.patch("/api/v1/devices/sim", json=change).json()["tracking"]["blinking"]
    assert kept == {"words": words, "off_level": 0.3, "miss_probability": 0.05}
    other = client.patch("/api/v1/devices/sim", json={"tracking": {"tracks": "always"}}).json()
    assert other["tracking"]["blinking"] == kept
    gone = client.patch("/api/v1/devices/sim", json={"tracking": {"blinking": None}}).json()
    assert gone["tracking"]["blinking"] is None
