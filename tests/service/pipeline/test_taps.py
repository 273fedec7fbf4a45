"""Taps: a detached one has all that it was being given, and gets no more."""

from threading import Event, Thread
from typing import Final

from hardware.simulated.driver import SimulatedDriver
from hardware.simulated.settings import SimulationSettings
from service.pipeline.active_calibration import ActiveCalibration
from service.pipeline.frame_batch import FrameBatch
from service.pipeline.pipeline_manager import PipelineManager
from service.protocols.stream.hub import Hub

WAIT_S = 240.0


class SlowTap:
    """Takes a batch in two steps, as one that keeps times and positions in two lists."""

    wants_pixels: Final = False

    def __init__(self) -> None:
        self.halfway, self.go_on = Event(), Event()
        self.begun = self.ended = 0

    def prepare(self, active: ActiveCalibration) -> None: ...

    def offer(self, batch: FrameBatch) -> None:
        self.begun += 1
        self.halfway.set()
        assert self.go_on.wait(WAIT_S)
        self.ended += 1


def test_detached_tap_is_not_in_the_middle_of_a_batch() -> None:
    live = PipelineManager(Hub(), "cpu")
    tap, detached = SlowTap(), Event()
    try:
        driver = SimulatedDriver("sim", SimulationSettings(frame_rate_hz=200.0))
        live.start_device("sim", driver, ActiveCalibration())
        session = live.session("sim")
        session.attach(tap)
        assert tap.halfway.wait(WAIT_S)

        def detach() -> None:
            session.detach(tap)
            detached.set()

        thread = Thread(target=detach)
        thread.start()
        assert not detached.wait(0.2)
        tap.go_on.set()
        assert detached.wait(WAIT_S)
        thread.join()
        assert tap.begun == tap.ended
    finally:
        tap.go_on.set()
        live.close()
