"""A device whose results nobody wants: nothing is rendered or computed, and status stays true."""

import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Final

import pytest

from hardware.simulated.driver import SimulatedDriver
from hardware.simulated.settings import SimulationSettings
from service.pipeline import device_session
from service.pipeline.active_calibration import ActiveCalibration
from service.pipeline.frame_batch import FrameBatch
from service.pipeline.pipeline_manager import PipelineManager
from service.protocols.stream.hub import Hub

if TYPE_CHECKING:
    from hardware.line_frame import LineFrame


class Tap:
    """Takes all frames."""

    wants_pixels: Final = True

    def __init__(self) -> None:
        self.frames: list[LineFrame] = []

    def prepare(self, active: ActiveCalibration) -> None: ...

    def offer(self, batch: FrameBatch) -> None:
        self.frames += batch.frames


def wait_for(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + 240.0
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


def test_device_that_nobody_looks_at_computes_nothing_until_a_tap_comes(
    monkeypatch: pytest.MonkeyPatch,
):
    monkeypatch.setattr(device_session, "IDLE_AFTER_S", 0.0)
    live = PipelineManager(Hub(), "cpu")
    try:
        driver = SimulatedDriver("sim", SimulationSettings(frame_rate_hz=200.0))
        live.start_device("sim", driver, ActiveCalibration())
        wait_for(lambda: driver.idle)
        before = live.status("sim")
        wait_for(lambda: live.status("sim").frames_received >= before.frames_received + 50)
        idle = live.status("sim")
        assert idle.frames_processed == before.frames_processed
        assert (idle.state, idle.frames_lost) == ("running", 0)
        tap = Tap()
        live.session("sim").attach(tap)
        wait_for(lambda: len(tap.frames) >= 20)
        assert all(frame.lines.shape == (4, 2048) for frame in tap.frames)
        sequences = [frame.sequence for frame in tap.frames]
        assert sequences == list(range(sequences[0], sequences[0] + len(sequences)))
    finally:
        live.close()


def test_device_that_is_only_sampled_computes_in_its_part_of_the_interval(
    monkeypatch: pytest.MonkeyPatch,
):
    monkeypatch.setattr(device_session, "IDLE_AFTER_S", 0.0)
    monkeypatch.setattr(device_session, "SAMPLE_S", 0.0)
    live = PipelineManager(Hub(), "cpu")
    try:
        driver = SimulatedDriver("sim", SimulationSettings(frame_rate_hz=200.0))
        live.start_device("sim", driver, ActiveCalibration())
        tap = Tap()
        live.session("sim").attach(tap, sampled=True)
        wait_for(lambda: driver.idle)
        before = live.status("sim")
        wait_for(lambda: live.status("sim").frames_received >= before.frames_received + 50)
        assert live.status("sim").frames_processed == before.frames_processed
        monkeypatch.setattr(device_session, "SAMPLE_S", device_session.SAMPLE_INTERVAL_S)
        seen = len(tap.frames)
        wait_for(lambda: len(tap.frames) >= seen + 20)
    finally:
        live.close()
