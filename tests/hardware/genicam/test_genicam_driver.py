"""GenicamDriver with mocked cameras: matching, losses, reconnection, close."""

import itertools
import threading
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import replace
from types import SimpleNamespace
from typing import TYPE_CHECKING

import numpy as np
import pytest

import hardware.clock_sync
import hardware.genicam.camera_stream
import hardware.genicam.driver
from compute.errors import InvalidParameter
from hardware.errors import DeviceChanged, DeviceNotConnected
from hardware.genicam.camera import Buffer
from hardware.genicam.driver import GenicamDriver
from hardware.genicam.settings import GenicamCamera, GenicamSettings
from hardware.line_frame import FrameFlag, LineFrame
from hardware.link import LinkedDriver, LinkState

if TYPE_CHECKING:
    from hardware.driver import Driver

PERIOD_NS = 1_000_000


class Bench:
    """The cameras of a test: what each sends, and which are there."""

    def __init__(self) -> None:
        self.waiting: dict[str, deque[Buffer]] = {}
        self.is_present: dict[str, bool] = {}
        self.width = 16
        self.widths: dict[str, int] = {}
        self.open = 0
        self.start_ns = time.monotonic_ns()
        self.refusals = 0

    def add(self, name: str) -> None:
        self.waiting[name], self.is_present[name] = deque(), True

    def send(self, name: str, *numbers: int, rows: int = 1, whole: bool = True) -> None:
        for number in numbers:
            self.waiting[name].append(self.buffer(number, rows, whole))

    def buffer(self, number: int, rows: int = 1, whole: bool = True) -> Buffer:
        lines = np.full((rows, self.width), number, np.uint16) if whole else None
        ns = number * PERIOD_NS * rows
        return Buffer(number, ns, self.start_ns + ns, lines, 16)


class PlayedCamera:
    """Stands where ``Camera`` does."""

    def __init__(self, which: GenicamCamera, bench: Bench) -> None:
        if not bench.is_present[which.camera]:
            raise DeviceNotConnected(f"camera {which.camera} cannot be used")
        if bench.refusals:
            bench.refusals -= 1
            raise InvalidParameter("exposure_us cannot be 200.0: busy")
        self._name, self._bench = which.camera, bench
        self.width, self.exposure_ns = bench.widths.get(which.camera, bench.width), 100_000
        self.line_rate_hz = 1e9 / PERIOD_NS
        bench.open += 1

    def start(self) -> None: ...

    def take(self, wait_us: int) -> Buffer | None:
        waiting = self._bench.waiting[self._name]
        if waiting:
            return waiting.popleft()
        time.sleep(min(wait_us, 1000) * 1e-6)
        return None

    def is_present(self) -> bool:
        return self._bench.is_present[self._name]

    def close(self) -> None:
        self._bench.open -= 1


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Iterator[Bench]:
    bench = Bench()
    monkeypatch.setattr(
        hardware.genicam.camera_stream, "Camera", lambda which, _: PlayedCamera(which, bench)
    )
    monkeypatch.setattr(hardware.genicam.driver, "SILENCE_S", 0.02)
    monkeypatch.setattr(hardware.genicam.camera_stream, "RETRY_S", (0.01,))
    yield bench
    assert bench.open == 0


def opened(bench: Bench, *names: str, rows: int = 1) -> GenicamDriver:
    for name in names:
        bench.add(name)
    cameras = tuple(GenicamCamera(f"sensor-{name}", name) for name in names)
    settings = GenicamSettings(cameras, 7.0, lines_per_buffer=rows, match_us=200.0)
    driver = GenicamDriver("bar", settings)
    driver.open()
    return driver


def taken(driver: GenicamDriver, count: int) -> list[LineFrame]:
    return list(itertools.islice(driver.frames(), count))


def test_it_is_a_driver_that_tells_of_its_link(bench: Bench) -> None:
    driver = opened(bench, "a")
    checked: Driver = driver
    assert isinstance(checked, LinkedDriver)
    described = driver.description
    assert [(s.name, s.pixels, s.pitch_um) for s in described.sensors] == [("sensor-a", 16, 7.0)]
    assert (described.bits, described.frame_rate_hz) == (8, 1000.0)
    driver.close()


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """The host's clock as frames see it: so far ahead of its monotonic one."""
    clock = SimpleNamespace(ahead_ns=0)
    hosts = SimpleNamespace(time_ns=lambda: clock.ahead_ns, monotonic_ns=lambda: 0)
    monkeypatch.setattr(hardware.clock_sync, "time", hosts)
    return clock


@pytest.mark.usefixtures("clock")
def test_frames_have_a_line_of_each_camera_of_the_same_moment(bench: Bench) -> None:
    driver = opened(bench, "a", "b")
    bench.send("a", 0, 1, 2, 4)
    bench.send("b", 1, 2, 3, 4)
    frames = taken(driver, 3)
    driver.close()
    assert [frame.lines[:, 0].tolist() for frame in frames] == [[1, 1], [2, 2], [4, 4]]
    assert [frame.sequence for frame in frames] == [1, 2, 4]
    # The device's clock begins with camera a's first exposure, which b did not see.
    assert [frame.exposure_device_ns for frame in frames] == [
        number * PERIOD_NS + 50_000 for number in (1, 2, 4)
    ]
    host = np.array([frame.exposure_host_ns for frame in frames]) - bench.start_ns
    # Buffers come when their exposure, 0.1 ms, is over: its middle is half of it before that.
    assert host.tolist() == [number * PERIOD_NS - 50_000 for number in (1, 2, 4)]
    assert [frame.flags for frame in frames] == [
        FrameFlag.NONE,
        FrameFlag.NONE,
        FrameFlag.OVERFLOW,
    ]
    counters = driver.link().counters
    assert (counters.frames_received, counters.frames_incomplete, counters.frames_lost) == (3, 2, 1)


@pytest.mark.parametrize("set_by_ns", [-10_000_000_000, 10_000_000_000])
def test_a_host_clock_that_is_set_moves_host_times_and_mixes_nothing(
    bench: Bench, clock: SimpleNamespace, set_by_ns: int
) -> None:
    driver = opened(bench, "a", "b")
    frames = driver.frames()
    bench.send("a", *range(10))
    bench.send("b", *range(10))
    before = list(itertools.islice(frames, 10))
    clock.ahead_ns = set_by_ns
    bench.send("a", *range(10, 30))
    bench.send("b", *range(10, 15), *range(16, 30))
    after = list(itertools.islice(frames, 19))
    driver.close()
    numbers = [*range(15), *range(16, 30)]
    assert [f.lines[:, 0].tolist() for f in before + after] == [[n, n] for n in numbers]
    assert [f.exposure_host_ns - bench.start_ns for f in after] == [
        n * PERIOD_NS - 50_000 + set_by_ns for n in numbers[10:]
    ]
    assert [f.sequence for f in after if f.flags & FrameFlag.OVERFLOW] == [16]


def test_each_line_of_a_buffer_is_an_exposure(bench: Bench) -> None:
    driver = opened(bench, "a", rows=4)
    bench.send("a", 7, 8, 10, rows=4)
    frames = taken(driver, 12)
    driver.close()
    assert [frame.sequence for frame in frames] == [*range(8), *range(12, 16)]
    assert np.diff([frame.exposure_device_ns for frame in frames[:8]]).tolist() == [PERIOD_NS] * 7
    assert driver.link().counters.frames_lost == 4
    assert frames[8].flags == FrameFlag.OVERFLOW


def test_full_scale_flags_the_frame(bench: Bench) -> None:
    driver = opened(bench, "a")
    bench.send("a", 254, 255)
    assert [frame.flags for frame in taken(driver, 2)] == [FrameFlag.NONE, FrameFlag.SATURATED]
    driver.close()


def test_lost_buffers_are_counted_and_told_when_there_is_nothing_else(bench: Bench) -> None:
    driver = opened(bench, "a")
    states: list[LinkState] = []

    def heard(state: LinkState) -> None:
        states.append(state)
        if state.state == "garbled":
            bench.send("a", 8)

    driver.listen(heard)
    bench.send("a", 1, 2)
    bench.send("a", 3, 4, whole=False)
    bench.send("a", 5)
    frames = driver.frames()
    assert [next(frames).sequence for _ in range(3)] == [0, 1, 4]
    assert "garbled" not in [state.state for state in states]
    bench.send("a", 6, 7, whole=False)
    assert next(frames).sequence == 7
    driver.close()
    assert [state.state for state in states][-2:] == ["garbled", "connected"]
    assert "parts of all buffers are lost" in (states[-2].reason or "")
    counters = driver.link().counters
    assert (counters.frames_garbled, counters.frames_lost) == (4, 4)


def test_a_camera_that_waits_is_silent_and_not_lost(bench: Bench) -> None:
    driver = opened(bench, "a")
    states: list[LinkState] = []

    def heard(state: LinkState) -> None:
        states.append(state)
        if state.state == "silent":
            bench.send("a", 5)

    driver.listen(heard)
    taken(driver, 1)
    driver.close()
    assert [state.state for state in states] == ["silent", "connected"]
    assert states[0].reason is not None
    assert states[0].reason.startswith('sensor "sensor-a", camera a, answers, but no lines came')
    assert driver.link().counters.reconnects == 0


def test_a_lost_camera_holds_the_frames_back_until_it_is_back(bench: Bench) -> None:
    driver = opened(bench, "a", "b")
    states: list[LinkState] = []
    driver.listen(states.append)
    bench.send("a", 1)
    bench.send("b", 1)
    frames = driver.frames()
    before = next(frames)

    def away_and_back() -> None:
        bench.is_present["b"] = False
        end = time.monotonic() + 240.0
        while driver.link().state != "disconnected":
            assert time.monotonic() < end
            time.sleep(0.005)
        bench.send("a", 50)
        time.sleep(0.05)
        bench.is_present["b"] = True
        while driver.link().counters.reconnects == 0:
            assert time.monotonic() < end
            time.sleep(0.005)
        bench.send("a", 60)
        bench.send("b", 60)

    thread = threading.Thread(target=away_and_back, daemon=True)
    thread.start()
    after = next(frames)
    thread.join(240.0)
    driver.close()
    phases = [phase for phase, _ in itertools.groupby(state.state for state in states)]
    # While one is away the other, whose lines wait, does not hide that.
    gone = phases.index("disconnected")
    assert phases[gone + 1 :] in (["connected"], ["silent", "connected"])
    assert (before.sequence, after.sequence) == (0, 59)
    assert (before.flags, after.flags) == (FrameFlag.NONE, FrameFlag.OVERFLOW)
    assert after.lines[:, 0].tolist() == [60, 60]
    lost = next(state for state in states if state.state == "disconnected")
    assert lost.reason is not None
    assert lost.reason.startswith('sensor "sensor-b", camera b, does not answer any more')


def replugged(bench: Bench, driver: GenicamDriver, *numbers: int) -> None:
    """Take the only camera away; as soon as that is told it is back, and sends these."""

    def heard(state: LinkState) -> None:
        if state.state == "disconnected" and not bench.is_present["a"]:
            bench.is_present["a"] = True
            bench.send("a", *numbers)

    driver.listen(heard)
    bench.is_present["a"] = False


@pytest.mark.parametrize("first", [1, 4, 204])
def test_the_first_frame_after_a_camera_came_back_says_that_some_are_lost(
    bench: Bench, first: int
) -> None:
    """How many is not known: it may go on counting or begin anew."""
    driver = opened(bench, "a")
    frames = driver.frames()
    bench.send("a", 1, 2, 3)
    got = list(itertools.islice(frames, 3))
    replugged(bench, driver, first, first + 1)
    got += itertools.islice(frames, 2)
    driver.close()
    assert [frame.sequence for frame in got] == [0, 1, 2, 3, 4]
    assert [frame.flags == FrameFlag.OVERFLOW for frame in got] == [False] * 3 + [True, False]
    assert driver.link().counters.frames_lost == 0


def test_the_first_frame_of_a_camera_that_began_anew_says_that_some_are_lost(bench: Bench) -> None:
    """Nobody saw it go; another camera's frames do not hide it."""
    driver = opened(bench, "a", "b")
    bench.send("a", 100, 101, 102, 103)
    bench.send("b", 100, 101)
    for number in (1, 2):  # its clock goes on, its numbers do not
        bench.waiting["b"].append(replace(bench.buffer(101 + number), number=number))
    frames = taken(driver, 4)
    driver.close()
    assert [frame.sequence for frame in frames] == [0, 1, 2, 3]
    assert [frame.flags == FrameFlag.OVERFLOW for frame in frames] == [False, False, True, False]


def test_a_camera_that_refuses_what_it_took_before_is_tried_again(bench: Bench) -> None:
    driver = opened(bench, "a")
    frames = driver.frames()
    bench.send("a", 1)
    next(frames)
    bench.refusals = hardware.genicam.camera_stream.REFUSALS
    replugged(bench, driver, 9)
    assert next(frames).sequence == 1
    bench.refusals = hardware.genicam.camera_stream.REFUSALS + 1
    replugged(bench, driver, 10)
    with pytest.raises(InvalidParameter, match="cannot be 200"):
        next(frames)
    driver.close()


def test_a_camera_that_comes_back_with_another_width_ends_the_frames(bench: Bench) -> None:
    driver = opened(bench, "a")
    bench.send("a", 1)
    frames = driver.frames()
    next(frames)
    bench.is_present["a"] = False

    def changed() -> None:
        while driver.link().state != "disconnected":
            time.sleep(0.005)
        bench.width = 32
        bench.is_present["a"] = True

    threading.Thread(target=changed, daemon=True).start()
    with pytest.raises(DeviceChanged, match='"sensor-a" had 16 pixels and has 32'):
        next(frames)
    driver.close()


def test_a_camera_that_is_not_there_is_said_when_opened(bench: Bench) -> None:
    for name in ("a", "b"):
        bench.add(name)
    bench.is_present["b"] = False
    settings = GenicamSettings((GenicamCamera("x", "a"), GenicamCamera("y", "b")), 7.0)
    driver = GenicamDriver("bar", settings)
    with pytest.raises(DeviceNotConnected, match="camera b cannot be used"):
        driver.open()
    driver.close()


def test_cameras_of_different_widths_are_refused(bench: Bench) -> None:
    bench.widths["b"] = 32
    with pytest.raises(InvalidParameter, match=r"differ in length \(.*16, .*32\); set one width"):
        opened(bench, "a", "b")
    deadline = time.monotonic() + 240.0
    while bench.open and time.monotonic() < deadline:  # they are let go in threads
        time.sleep(0.01)


def test_close_ends_a_waiting_thread_and_lets_the_cameras_go(bench: Bench) -> None:
    driver = opened(bench, "a", "b")
    got: list[LineFrame] = []
    reader = threading.Thread(target=lambda: got.extend(driver.frames()), daemon=True)
    reader.start()
    time.sleep(0.05)
    driver.close()
    driver.close()
    reader.join(240.0)
    assert not reader.is_alive()
    assert got == []
    assert bench.open == 0


def test_opened_again_it_begins_anew_and_ends_the_old_run(bench: Bench) -> None:
    driver = opened(bench, "a")
    bench.send("a", 1, 2)
    old = driver.frames()
    assert next(old).sequence == 0
    driver.open()
    assert list(old) == []
    bench.send("a", 9)
    new = driver.frames()
    assert next(new).sequence == 0
    driver.close()
    assert list(new) == []


def test_description_and_frames_before_open_are_errors() -> None:
    driver = GenicamDriver("bar", GenicamSettings((GenicamCamera("x", "a"),), 7.0))
    with pytest.raises(RuntimeError, match="call open"):
        _ = driver.description
    with pytest.raises(RuntimeError, match="call open"):
        next(driver.frames())
    driver.close()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"pitch_um": 0.0}, "pitch_um is 0.0; it must be more than 0"),
        ({"lines_per_buffer": 0}, "lines_per_buffer is 0; it must be at least 1"),
        ({"pixel_format": "RGB8"}, "pixel_format is 'RGB8'; it must be one of Mono8"),
        ({"peaks": "median"}, "peaks is 'median'; it must be one of"),
        ({"cameras": ()}, "cameras is .*; it must be of length at least 1"),
        (
            {"cameras": (GenicamCamera("x", "a"), GenicamCamera("x", "b"))},
            '"x" is given as the name of two sensors',
        ),
        (
            {"cameras": (GenicamCamera("x", "a"), GenicamCamera("y", "a"))},
            '"a" is given as the camera of two sensors',
        ),
    ],
)
def test_settings_without_meaning_are_refused(change: dict[str, object], message: str) -> None:
    given = {"cameras": (GenicamCamera("x", "a"),), "pitch_um": 7.0} | change
    with pytest.raises(InvalidParameter, match=message):
        GenicamSettings(**given)  # type: ignore[arg-type]
