"""ReaderThread: frames are read on while the thread that has read one processes it."""

import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from queue import SimpleQueue

import numpy as np
import pytest

from compute.errors import LumilineError
from hardware.driver import DeviceDescription, SensorDescription
from hardware.line_frame import LineFrame
from service.pipeline import threads
from service.pipeline.threads import TAKE_OVER_S, FrameRing, ReaderThread

WAIT_S = 240.0
PIXELS = np.zeros((1, 4), np.uint16)


class QueueDriver:
    """Gives the frames that it is given; None ends them, an error is raised."""

    lossless = False
    description = DeviceDescription(
        "bar", (SensorDescription("a", 4, 10.0),), 1000.0, 12, 1.0, 1.0, 0.0, 1
    )

    def __init__(self) -> None:
        self.queue: SimpleQueue[LineFrame | Exception | None] = SimpleQueue()
        self.closed = False

    def open(self) -> None: ...

    def frames(self) -> Iterator[LineFrame]:
        while (frame := self.queue.get()) is not None:
            if isinstance(frame, Exception):
                raise frame
            yield frame

    def close(self) -> None:
        self.closed = True
        self.queue.put(None)


def frame(number: int) -> LineFrame:
    return LineFrame("sim", number, number, number, None, PIXELS)


def wait_for(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + WAIT_S
    while not condition():
        assert time.monotonic() < end, "it did not come true"
        time.sleep(0.001)


class Reading:
    """A reader whose frames are processed, by what reads them, until they may go on."""

    def __init__(self) -> None:
        self.driver = QueueDriver()
        self.processed: list[int] = []
        self.threads: list[str] = []
        self.busy: set[int] = set()
        """Frames that are processed for as long as nobody says otherwise."""
        self.go_on = threading.Event()
        self.changes = 0
        self.fault: Exception | None = None
        self.ring = FrameRing(1000)
        self.reader = ReaderThread("sim", self.driver, self.ring, self.process, self.change)
        self.reader.start()

    def process(self) -> None:
        if self.fault is not None:
            raise self.fault
        for one in self.ring.take(1):
            self.threads.append(threading.current_thread().name)
            if one.sequence in self.busy:
                self.go_on.wait(WAIT_S)
            self.processed.append(one.sequence)

    def change(self) -> None:
        self.changes += 1


@pytest.fixture
def reading() -> Iterator[Reading]:
    reading = Reading()
    yield reading
    reading.go_on.set()
    reading.reader.stop()


def test_other_thread_reads_on_while_a_frame_is_processed_for_long(reading: Reading) -> None:
    reading.busy = {1}
    for number in range(5):
        reading.driver.queue.put(frame(number))
    wait_for(lambda: len(reading.processed) == 4)
    assert reading.processed == [0, 2, 3, 4]
    assert len(set(reading.threads[:2])) == 1
    assert set(reading.threads) == {"reader-sim", "standby-sim"}
    # The one that was busy stands by, and leads again when the other is.
    reading.go_on.set()
    wait_for(lambda: len(reading.processed) == 5)
    reading.go_on.clear()
    reading.busy = {6}
    for number in range(5, 9):
        reading.driver.queue.put(frame(number))
    wait_for(lambda: len(reading.processed) == 8)
    assert reading.processed[5:] == [5, 7, 8]
    assert reading.ring.lost == reading.ring.dropped == 0


def test_end_of_the_frames_ends_both_threads_and_is_told_once(reading: Reading) -> None:
    reading.busy = {0}
    reading.driver.queue.put(frame(0))
    reading.driver.queue.put(None)
    wait_for(lambda: reading.changes == 1)
    assert (reading.reader.state, reading.reader.reason) == (
        "ended", "the source has no more frames"
    )  # fmt: skip
    assert reading.driver.closed
    reading.go_on.set()
    names = {"reader-sim", "standby-sim"}
    wait_for(lambda: not names & {one.name for one in threading.enumerate()})
    assert reading.changes == 1
    assert reading.processed == [0]


def test_error_of_the_driver_behind_a_frame_in_hand_is_its_state(reading: Reading) -> None:
    reading.busy = {0}
    reading.driver.queue.put(frame(0))
    reading.driver.queue.put(LumilineError("the cable is out"))
    wait_for(lambda: reading.changes == 1)
    assert (reading.reader.state, reading.reader.reason) == ("failed", "the cable is out")


def test_fault_of_what_processes_frames_is_none_of_the_driver(reading: Reading) -> None:
    reading.fault = ArithmeticError("singular")
    reading.driver.queue.put(frame(0))
    wait_for(lambda: reading.ring.received == 1)
    reading.fault = None
    reading.driver.queue.put(frame(1))
    wait_for(lambda: reading.processed == [0])
    assert reading.reader.state == "running"


def test_stop_ends_both_threads_while_a_frame_is_processed(reading: Reading) -> None:
    reading.busy = {0}
    reading.driver.queue.put(frame(0))
    wait_for(lambda: len(reading.threads) == 1)
    stopping = threading.Thread(target=reading.reader.stop)
    stopping.start()
    wait_for(lambda: reading.driver.closed)
    reading.go_on.set()
    stopping.join(WAIT_S)
    assert reading.reader.state == "stopped"
    assert not {"reader-sim", "standby-sim"} & {one.name for one in threading.enumerate()}
    assert reading.changes == 0


class SlowRing(FrameRing):
    """Keeps whoever puts a frame waiting."""

    def put(self, frame: LineFrame) -> None:
        time.sleep(6.0 * TAKE_OVER_S)
        super().put(frame)


def test_frames_stay_in_order_where_a_thread_is_held_up_before_it_hands_its_frame_over() -> None:
    driver, ring, over = QueueDriver(), SlowRing(100), threading.Event()
    reader = ReaderThread("sim", driver, ring, lambda: None, over.set)
    for number in range(4):
        driver.queue.put(frame(number))
    driver.queue.put(None)
    reader.start()
    assert over.wait(WAIT_S)
    reader.stop()
    assert [one.sequence for one in ring.take(100)] == [0, 1, 2, 3]
    assert ring.lost == 0


@pytest.mark.parametrize(("rate_hz", "lossless"), [(1000.0, True), (30.0, False)])
def test_only_devices_that_are_fast_and_cannot_wait_have_a_thread_that_stands_by(
    rate_hz: float, lossless: bool
) -> None:
    driver = QueueDriver()
    driver.description = replace(driver.description, frame_rate_hz=rate_hz)
    driver.lossless = lossless
    reader = ReaderThread("sim", driver, FrameRing(10), lambda: None, lambda: None)
    reader.start()
    names = [thread.name for thread in threading.enumerate()]
    reader.stop()
    assert "reader-sim" in names
    assert "standby-sim" not in names


def test_hung_driver_holds_stop_up_for_no_longer_than_one_join(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(threads, "JOIN_TIMEOUT_S", 0.05)
    driver = QueueDriver()
    monkeypatch.setattr(driver, "close", lambda: None)
    reader = ReaderThread("sim", driver, FrameRing(10), lambda: None, lambda: None)
    reader.start()
    reader.stop()
    wait_for(lambda: "standby-sim" not in [one.name for one in threading.enumerate()])
    driver.queue.put(None)
    wait_for(lambda: "reader-sim" not in [one.name for one in threading.enumerate()])
