"""Tcd1304Driver with simulated boards: frames, clocks, faults, unplugging, close."""

import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
import pytest

from hardware.errors import DeviceNotConnected
from hardware.line_frame import FrameFlag, LineFrame
from hardware.link import LinkedDriver, LinkState
from hardware.serial.port import CloseSignal
from hardware.tcd1304.board import BoardLink, BoardScan
from hardware.tcd1304.driver import Tcd1304Driver, combined_exposure_time
from hardware.tcd1304.protocol import Request
from hardware.tcd1304.response import OFFSET_COUNTS
from hardware.tcd1304.settings import Tcd1304Board, Tcd1304Settings
from tests.hardware.tcd1304.simulated_board import Respond, SimulatedBoard, response_counts

if TYPE_CHECKING:
    from hardware.driver import Driver

UNPLUGS = int(os.environ.get("LUMILINE_TEST_UNPLUGS", "10"))
GAP_MS = 30.0


def line_at(pixel: int) -> bytes:
    light = np.zeros(3648)
    light[pixel] = 1000.0
    return response_counts(light).astype("<u2").tobytes()


def always(data: bytes) -> Respond:
    return lambda _: data


def cyclic(*answers: bytes | None, then: bytes) -> Respond:
    """Each answer once, then one for ever."""
    waiting = list(answers)
    return lambda _: waiting.pop(0) if waiting else then


@contextmanager
def bar(*responds: Respond, realtime: bool = False) -> Iterator[list[SimulatedBoard]]:
    with ExitStack() as stack:
        boards = [SimulatedBoard(respond, realtime=realtime) for respond in responds]
        for board in boards:
            stack.callback(board.close)
        yield boards


def driver_of(boards: list[SimulatedBoard], **settings: float) -> Tcd1304Driver:
    named = tuple(Tcd1304Board(f"s{i}", board.url) for i, board in enumerate(boards))
    return Tcd1304Driver("bar", Tcd1304Settings(named, **{"gap_ms": GAP_MS, **settings}))  # type: ignore[arg-type]


@dataclass
class Taken:
    """What a driver yields and tells, read in a thread as the service does."""

    driver: Tcd1304Driver
    frames: list[LineFrame] = field(default_factory=list)
    states: list[LinkState] = field(default_factory=list)

    def __enter__(self) -> "Taken":
        self.driver.listen(self.states.append)
        self.driver.open()
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.driver.close()
        self._thread.join(10.0)
        assert not self._thread.is_alive()

    def _read(self) -> None:
        for frame in self.driver.frames():
            self.frames.append(frame)

    def until(self, what: Callable[["Taken"], bool]) -> None:
        end = time.monotonic() + 20.0
        while not what(self):
            assert time.monotonic() < end, (len(self.frames), self.driver.link())
            time.sleep(0.002)

    def frames_more(self, count: int) -> None:
        have = len(self.frames)
        self.until(lambda taken: len(taken.frames) >= have + count)

    def phases(self) -> list[str]:
        return [state.state for state in self.states]


def marked(taken: Taken) -> list[tuple[int, bool]]:
    """Return the first three frames' numbers, and whether they say that some before are lost."""
    return [(f.sequence, f.flags == FrameFlag.OVERFLOW) for f in taken.frames[:3]]


def test_it_is_a_driver_that_tells_of_its_link() -> None:
    with bar(always(line_at(0))) as boards:
        driver = driver_of(boards)
        checked: Driver = driver
        assert isinstance(checked, LinkedDriver)
        assert [(s.name, s.pixels, s.pitch_um) for s in driver.description.sensors] == [
            ("s0", 3648, 8.0)
        ]
        assert (driver.description.bits, driver.description.offset_counts) == (12, OFFSET_COUNTS)


def test_frames_hold_one_line_of_each_board_in_order() -> None:
    with bar(always(line_at(10)), always(line_at(20)), always(line_at(3647))) as boards:
        with Taken(driver_of(boards)) as taken:
            taken.frames_more(3)
        for number, frame in enumerate(taken.frames):
            assert (frame.device, frame.sequence, frame.marker) == ("bar", number, None)
            assert frame.lines.shape == (3, 3648)
            assert frame.lines.argmax(axis=1).tolist() == [10, 20, 3647]
            assert frame.lines.max() == OFFSET_COUNTS + 1000
            assert frame.flags == FrameFlag.NONE
        assert taken.states == []
        counters = taken.driver.link().counters
        assert counters.received_bytes == 3 * 7388 * counters.frames_received
        assert boards[0].requests[0] == Request(14_776, 14_776)


def test_the_rate_is_that_of_the_line_and_the_firmware() -> None:
    """30 ms to empty the CCD, 5 pulses and a readout of 7.388 ms, 73,880 bits, the gap."""
    with bar(always(line_at(1))) as boards:
        slow = driver_of(boards).description.frame_rate_hz
        assert slow == pytest.approx(1.0 / (0.030 + 6 * 0.007388 + 0.64132 + 0.030), rel=1e-4)
        fast = driver_of(boards, baud_rate=921_600).description.frame_rate_hz
        assert fast == pytest.approx(1.0 / (0.030 + 6 * 0.007388 + 0.08016 + 0.030), rel=1e-4)


def test_exposures_are_timed_within_their_uncertainty() -> None:
    """The boards wait as real ones: their exposure ends a readout before the answer."""
    exposed_ns: list[int] = []

    def respond(request: Request) -> bytes:
        exposed_ns.append(time.time_ns() - request.centre_to_response_ns)
        return line_at(1)

    with bar(respond, realtime=True) as boards:
        driver = driver_of(boards, exposure_us=30_000.0)
        with Taken(driver) as taken:
            taken.frames_more(4)
        uncertainty_ns = driver.exposure_uncertainty_ns
        assert uncertainty_ns is not None
        assert 0 < uncertainty_ns <= 10_000_000
        misses = [
            frame.exposure_host_ns - when
            for frame, when in zip(taken.frames, exposed_ns, strict=False)
        ]
        # A machine that is busy reads late; not all four times by more than the latency.
        assert min(abs(miss) for miss in misses) <= uncertainty_ns + 1_000_000
        device = np.array([frame.exposure_device_ns for frame in taken.frames])
        host = np.array([frame.exposure_host_ns for frame in taken.frames])
        assert (np.diff(device) > 0).all()
        np.testing.assert_allclose(np.diff(host), np.diff(device), atol=5e6)


def test_the_uncertainty_grows_by_what_the_boards_lie_apart() -> None:
    nothing = np.zeros(0, np.uint16)
    together = [BoardScan(nothing, 100, 120, 0), BoardScan(nothing, 100, 120, 0)]
    assert combined_exposure_time(together) == (110, 10)
    apart = [BoardScan(nothing, 100, 120, 0), BoardScan(nothing, 200, 220, 0)]
    assert combined_exposure_time(apart) == (160, 60)


def test_full_pixels_flag_the_frame() -> None:
    with bar(always(line_at(5))) as boards, Taken(driver_of(boards, saturated_at=2200)) as taken:
        taken.frames_more(1)
    assert taken.frames[0].flags == FrameFlag.SATURATED
    assert taken.frames[0].lines[0, 5] == 4095


@pytest.mark.slow
@pytest.mark.parametrize(
    ("bad", "says"),
    [
        (line_at(1)[:4000], "4000 bytes came where an answer has 7388"),
        (line_at(1)[1:], "7387 bytes came"),
        (b"x" + line_at(1), "7389 bytes came"),
        (b"boot 1.0\r\n", "10 bytes came"),
        (line_at(1)[1:] + b"\x0c", "where counts go to 4095"),
        (line_at(1) * 5, "bytes came where"),
    ],
)
def test_a_bad_answer_is_told_counted_and_left_out(bad: bytes, says: str) -> None:
    good = line_at(7)
    with bar(cyclic(good, bad, then=good)) as boards, Taken(driver_of(boards)) as taken:
        taken.frames_more(4)
    assert {int(frame.lines.argmax()) for frame in taken.frames} == {7}
    assert marked(taken) == [(0, False), (2, True), (3, False)]
    assert taken.phases() == ["garbled", "connected"]
    reason = taken.states[0].reason
    assert reason is not None
    assert says in reason
    assert reason.startswith(f'sensor "s0" at {boards[0].url}')
    counters = taken.driver.link().counters
    assert (counters.frames_garbled, counters.frames_lost) == (1, 1)


def test_a_board_that_was_left_in_continuous_mode_is_stopped_by_the_first_request() -> None:
    stopped = threading.Event()

    def respond(_: Request) -> bytes:
        stopped.set()
        return line_at(7)

    with bar(respond) as boards:

        def flood() -> None:
            while not stopped.is_set():
                boards[0].send(line_at(900))
                time.sleep(0.01)

        driver = driver_of(boards, baud_rate=4_000_000)
        with Taken(driver) as taken:
            thread = threading.Thread(target=flood, daemon=True)
            thread.start()
            taken.frames_more(3)
            thread.join(5.0)
    assert {int(frame.lines.argmax()) for frame in taken.frames[-2:]} == {7}


def test_silence_is_told_and_ends_when_the_board_answers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hardware.tcd1304.board.RESPONSE_TIMEOUT_S", 0.1)
    good = line_at(7)
    with bar(cyclic(good, b"", then=good)) as boards, Taken(driver_of(boards)) as taken:
        taken.frames_more(3)
    assert taken.phases() == ["silent", "connected"]
    reason = taken.states[0].reason
    assert reason is not None
    assert "did not answer a request within 0.2 s" in reason
    assert marked(taken) == [(0, False), (1, True), (2, False)]
    assert taken.driver.link().counters.frames_lost == 0


def test_one_board_missing_holds_back_the_frame_and_is_named() -> None:
    good = line_at(7)
    with (
        bar(always(good), cyclic(good, None, then=good)) as boards,
        Taken(driver_of(boards)) as taken,
    ):
        taken.frames_more(3)
    assert taken.phases() == ["disconnected", "connected"]
    reason = taken.states[0].reason
    assert reason is not None
    assert reason.startswith(f'sensor "s1" at {boards[1].url} was lost')
    counters = taken.driver.link().counters
    assert (counters.frames_incomplete, counters.frames_lost, counters.reconnects) == (1, 1, 1)
    assert marked(taken) == [(0, False), (2, True), (3, False)]


@pytest.mark.slow
def test_unplugged_and_connected_again_many_times(monkeypatch: pytest.MonkeyPatch) -> None:
    """Not only in an answer: cut before it, in the middle of it, and refused for a while."""
    monkeypatch.setattr("hardware.tcd1304.driver.RETRY_S", (0.01,))
    good = line_at(7)
    with bar(always(good)) as boards, Taken(driver_of(boards)) as taken:
        board = boards[0]
        for number in range(UNPLUGS):
            taken.frames_more(1)
            if number % 3 == 0:
                board.unplug()
            elif number % 3 == 1:
                board.respond = cyclic(None, then=good)
            else:
                board.close()
                taken.until(lambda t: t.driver.link().state == "disconnected")
                boards[0] = board = SimulatedBoard(always(good), port=board.port)
            taken.until(lambda t, n=number: t.driver.link().counters.reconnects == n + 1)  # type: ignore[misc]
        taken.frames_more(1)
        assert taken.driver.link().state == "connected"
    boards[0].close()
    assert {int(frame.lines.argmax()) for frame in taken.frames} == {7}
    sequence = [frame.sequence for frame in taken.frames]
    device = [frame.exposure_device_ns for frame in taken.frames]
    assert sequence == sorted(set(sequence))
    assert device == sorted(set(device))
    assert taken.phases() == ["disconnected", "connected"] * UNPLUGS
    assert threading.active_count() < 20


def test_a_board_that_is_not_there_is_said_when_opened() -> None:
    board = SimulatedBoard(always(b""))
    board.close()
    driver = driver_of([board])
    with pytest.raises(DeviceNotConnected, match=r'sensor "s0": socket://.* cannot be opened'):
        driver.open()
    driver.close()
    nowhere = Tcd1304Settings((Tcd1304Board("s0", "/dev/ttyNone"),))
    with pytest.raises(DeviceNotConnected, match="plug the board in"):
        Tcd1304Driver("bar", nowhere).open()


def test_close_ends_a_driver_that_waits_for_an_answer_at_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # A close that waited for the answer, too, would not come to the end of the test.
    monkeypatch.setattr("hardware.tcd1304.board.RESPONSE_TIMEOUT_S", 3600.0)
    with bar(always(b"")) as boards:
        driver = driver_of(boards, exposure_us=6e7)
        with Taken(driver) as taken:
            taken.until(lambda _: bool(boards[0].requests))
            driver.close()
            driver.close()
        assert taken.frames == []
        assert taken.states == []


def test_a_board_that_is_asked_after_the_end_is_not_connected_again() -> None:
    """A thread that asks may come to it just after ``close``: nobody would close the port."""
    with bar(always(line_at(7))) as boards:
        settings = driver_of(boards)._settings
        closed = CloseSignal()
        link = BoardLink(settings.boards[0], settings, closed)
        link.connect()
        assert link.connected
        closed.set()
        link.close()
        link.ask()
        assert not link.connected
        with pytest.raises(DeviceNotConnected, match="closed while it was opened"):
            link.connect()
        closed.close()


def test_opened_again_it_begins_anew() -> None:
    with bar(always(line_at(7))) as boards:
        driver = driver_of(boards)
        driver.open()
        old = driver.frames()
        assert [next(old).sequence for _ in range(2)] == [0, 1]
        driver.open()
        assert list(old) == []
        new = driver.frames()
        assert next(new).sequence == 0
        assert driver.link().counters.frames_received == 1
        driver.close()
        assert list(new) == []


def test_frames_before_open_are_an_error() -> None:
    with bar(always(b"")) as boards, pytest.raises(RuntimeError, match="call open"):
        driver_of(boards).frames()


def test_a_board_on_a_pseudo_terminal() -> None:
    """The way of a real port: raw bytes through the kernel's terminal, and its end."""
    master, slave = os.openpty()
    name = os.ttyname(slave)
    good = line_at(7)

    def serve() -> None:
        try:
            while os.read(master, 4096):
                sent = 0
                while sent < len(good):
                    sent += os.write(master, good[sent : sent + 512])
        except OSError:
            return

    thread = threading.Thread(target=serve, daemon=True)
    settings = Tcd1304Settings((Tcd1304Board("s0", name),), gap_ms=GAP_MS)
    with Taken(Tcd1304Driver("bar", settings)) as taken:
        thread.start()
        taken.frames_more(3)
        os.close(slave)
        os.close(master)
        taken.until(lambda t: t.driver.link().state == "disconnected")
    assert {int(frame.lines.argmax()) for frame in taken.frames} == {7}
