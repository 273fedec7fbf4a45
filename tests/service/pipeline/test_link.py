"""Devices that go and come back: what the live side says of them, and does."""

import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from queue import SimpleQueue
from typing import Any

import numpy as np
import pytest

from compute.errors import InvalidParameter, LumilineError
from hardware.driver import DeviceDescription
from hardware.errors import DeviceChanged, DeviceNotConnected
from hardware.line_frame import LineFrame
from hardware.link import LinkCounters, LinkState
from hardware.simulated.driver import SimulatedDriver
from hardware.simulated.settings import SimulationSettings
from service.pipeline import pipeline_manager
from service.pipeline.pipeline_manager import PipelineManager
from service.problems.errors import DeviceNotRunning, NotReady
from service.protocols.stream.hub import Hub

DESCRIPTION = SimulatedDriver("cable", SimulationSettings()).description


class Told(Hub):
    """Keeps the status messages."""

    def __init__(self) -> None:
        super().__init__()
        self.messages: list[dict[str, Any]] = []

    def publish(self, device_id: str, message: dict[str, Any]) -> None:
        self.messages.append(message)
        super().publish(device_id, message)


class Cable:
    """A linked driver that does what the test says."""

    lossless = False

    def __init__(self, plugged: bool = True) -> None:
        self.plugged = plugged
        self.error: LumilineError | None = None
        self.opened = 0
        self.closed = threading.Event()
        self.description: DeviceDescription = DESCRIPTION
        self._state = LinkState("connected")
        self._does: SimpleQueue[LineFrame | LinkState | Exception | None] = SimpleQueue()
        self._changed: Callable[[LinkState], None] = lambda _: None

    def open(self) -> None:
        self.opened += 1
        self.closed.clear()
        if self.error is not None:
            raise self.error
        if not self.plugged:
            raise DeviceNotConnected("there is no /dev/ttyX")

    def close(self) -> None:
        self.closed.set()
        self._does.put(None)

    def listen(self, changed: Callable[[LinkState], None]) -> None:
        self._changed = changed

    def link(self) -> LinkState:
        return self._state

    def does(self, what: LineFrame | LinkState | Exception) -> None:
        self._does.put(what)

    def frames(self) -> Iterator[LineFrame]:
        while (what := self._does.get()) is not None:
            if isinstance(what, Exception):
                raise what
            if isinstance(what, LinkState):
                self._state = what
                self._changed(what)
            else:
                yield what


def frame(sequence: int) -> LineFrame:
    return LineFrame("cable", sequence, sequence, sequence, 0, np.zeros((4, 2048), np.uint16))


@pytest.fixture
def live(monkeypatch: pytest.MonkeyPatch) -> Iterator[PipelineManager]:
    # The first start in a process loads kernels, which takes long on a busy machine.
    monkeypatch.setattr(pipeline_manager, "FIRST_ATTEMPT_S", 240.0)
    manager = PipelineManager(Hub(), "cpu")
    manager.streams = Told()
    yield manager
    manager.close()


def states(live: PipelineManager) -> list[tuple[str, str | None, str | None]]:
    assert isinstance(live.streams, Told)
    return [(one["state"], one["reason"], one["link"]) for one in live.streams.messages]


def wait_for(condition: Callable[[], bool], seconds: float = 240.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not come true"
        time.sleep(0.002)


GONE = LinkState(
    "disconnected", "the cable was pulled; trying again", LinkCounters(frames_received=1)
)
SILENT = LinkState("silent", "nothing came for 1 s", LinkCounters(frames_received=1))
GARBLED = LinkState(
    "garbled", "what comes is no frame", LinkCounters(frames_received=1, frames_garbled=9)
)
BACK = LinkState("connected", None, LinkCounters(frames_received=1, reconnects=1))


def test_each_change_of_the_link_is_told_behind_the_frames_before_it(live: PipelineManager) -> None:
    cable = Cable()
    assert live.start_device("cable", cable) == DESCRIPTION
    cable.does(frame(0))
    for state in (SILENT, GARBLED, GONE, BACK):
        cable.does(state)
    cable.does(frame(1))
    wait_for(lambda: live.status("cable").frames_processed == 2)
    wait_for(lambda: len(states(live)) == 6)
    assert states(live)[:2] == [("starting", None, None), ("running", None, "connected")]
    # Told from the status at that time: the last of a quick series is what counts.
    assert states(live)[-1] == ("running", None, "connected")
    status = live.status("cable")
    assert (status.state, status.link) == ("running", BACK)


@pytest.mark.parametrize(
    ("link", "state"),
    [(SILENT, "running"), (GARBLED, "running"), (GONE, "disconnected")],
)
def test_a_status_has_the_links_state_and_reason(
    live: PipelineManager, link: LinkState, state: str
) -> None:
    cable = Cable()
    live.start_device("cable", cable)
    cable.does(link)
    wait_for(lambda: len(states(live)) == 3)
    assert states(live)[-1] == (state, link.reason, link.state)
    status = live.status("cable")
    assert (status.state, status.reason, status.link) == (state, link.reason, link)


def test_nothing_is_captured_of_a_device_that_is_disconnected(live: PipelineManager) -> None:
    cable = Cable()
    live.start_device("cable", cable)
    cable.does(GONE)
    wait_for(lambda: live.status("cable").state == "disconnected")
    with pytest.raises(DeviceNotRunning, match="disconnected: the cable was pulled"):
        live.collect("cable", 1, 0, 5.0)
    cable.does(BACK)
    wait_for(lambda: live.status("cable").state == "running")
    positions, _ = live.collect("cable", 1, 0, 0.05)
    assert positions.shape == (0, 4)


def test_a_capture_ends_when_the_device_is_lost_meanwhile(live: PipelineManager) -> None:
    cable = Cable()
    live.start_device("cable", cable)
    timer = threading.Timer(0.1, lambda: cable.does(GONE))
    timer.start()
    with pytest.raises(DeviceNotRunning, match="the cable was pulled"):
        live.collect("cable", 1, 0, 20.0)
    timer.join()


def test_a_capture_ends_when_the_server_stops_meanwhile(
    live: PipelineManager, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It would wait for a minute, and the process with it."""
    live.start_device("cable", Cable())
    wait_for(lambda: live.status("cable").state == "running", 240.0)
    session = live.session("cable")
    assert isinstance(live.streams, Hub)
    close = live.streams.close
    monkeypatch.setattr(session, "attach", lambda _: close("the server is stopping"))
    with pytest.raises(NotReady, match="the server is stopping"):
        live.collect("cable", 1, 0, 60.0)


def test_a_device_that_is_not_there_is_waited_for(
    live: PipelineManager, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.pipeline.device_connector.RETRY_S", (0.01,))
    cable = Cable(plugged=False)
    assert live.start_device("cable", cable) is None
    status = live.status("cable")
    assert (status.state, status.reason) == ("disconnected", "there is no /dev/ttyX")
    wait_for(lambda: cable.opened > 3)
    with pytest.raises(DeviceNotRunning, match="there is no /dev/ttyX"):
        live.collect("cable", 1, 0, 1.0)
    cable.plugged = True
    wait_for(lambda: live.status("cable").state == "running")
    assert [state for state, _, _ in states(live)] == ["starting", "disconnected", "running"]
    cable.does(frame(0))
    wait_for(lambda: live.status("cable").frames_processed == 1)


def test_a_device_that_is_waited_for_can_be_stopped_and_started_anew(live: PipelineManager) -> None:
    absent = Cable(plugged=False)
    live.start_device("cable", absent)
    live.stop_device("cable")
    assert live.status("cable").state == "stopped"
    assert absent.closed.is_set()
    live.start_device("cable", Cable(plugged=False))
    there = Cable()
    assert live.start_device("cable", there) == DESCRIPTION
    assert live.status("cable").state == "running"
    assert [state for state, _, _ in states(live)] == [
        "starting", "disconnected", "stopped",
        "starting", "disconnected", "stopped",
        "starting", "running",
    ]  # fmt: skip


def test_a_device_that_comes_up_as_another_one_is_refused(
    live: PipelineManager, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.pipeline.device_connector.RETRY_S", (0.01,))

    def accept(description: DeviceDescription) -> None:
        if len(description.sensors) != 4:
            raise InvalidParameter(f"it has {len(description.sensors)} sensors")

    cable = Cable(plugged=False)
    live.start_device("cable", cable, accept=accept)
    cable.description = replace(DESCRIPTION, sensors=DESCRIPTION.sensors[:3])
    cable.plugged = True
    wait_for(lambda: live.status("cable").state == "failed")
    assert live.status("cable").reason == "it has 3 sensors"
    assert cable.closed.is_set()
    with pytest.raises(InvalidParameter):
        live.start_device("cable", cable, accept=accept)


def test_a_device_that_comes_back_as_another_one_has_failed(live: PipelineManager) -> None:
    cable = Cable()
    live.start_device("cable", cable)
    cable.does(GONE)
    cable.does(DeviceChanged("what is connected now has 3 sensors"))
    wait_for(lambda: live.status("cable").state == "failed")
    assert live.status("cable").reason == "what is connected now has 3 sensors"


def test_a_driver_that_cannot_be_opened_says_why(live: PipelineManager) -> None:
    cable = Cable()
    cable.error = InvalidParameter("the port's speed is -1")
    with pytest.raises(InvalidParameter, match="speed is -1"):
        live.start_device("cable", cable)
    assert live.status("cable").state == "failed"
    assert live.status("cable").reason == "the port's speed is -1"


def test_one_device_that_is_waited_for_keeps_no_other_waiting(live: PipelineManager) -> None:
    entered, leave = threading.Event(), threading.Event()

    class Slow(Cable):
        def open(self) -> None:
            entered.set()
            leave.wait(240.0)
            super().open()

        def close(self) -> None:
            leave.set()
            super().close()

    slow = Slow()
    starter = threading.Thread(target=live.start_device, args=("slow", slow))
    starter.start()
    assert entered.wait(240.0)
    assert live.status("slow").state == "starting"
    assert live.start_device("cable", Cable()) == DESCRIPTION
    assert not leave.is_set()
    live.stop_device("slow")
    starter.join()
    assert live.status("slow").state == "stopped"
