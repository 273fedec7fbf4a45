"""SimulatedDriver: order, clocks, lost exposures, close from another thread."""

import itertools
import threading
import time
from dataclasses import replace

import numpy as np
import pytest

import hardware.clock_sync
import hardware.simulated.driver
from hardware.line_frame import FrameFlag, LineFrame
from hardware.simulated.driver import FIFO_S, FrameRenderer, SimulatedDriver
from hardware.simulated.scenes import CalibrationTarget, StillPoints
from hardware.simulated.settings import SimulationSettings

FAST = SimulationSettings(realtime=False, duration_s=0.05)


def taken(settings: SimulationSettings, count: int | None = None) -> list[LineFrame]:
    driver = SimulatedDriver("bar", settings)
    driver.open()
    frames = list(itertools.islice(driver.frames(), count))
    driver.close()
    return frames


class Clock:
    """A host's clock that moves only when the driver waits or the test says so."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now_ns = 10**12
        monkeypatch.setattr(hardware.simulated.driver, "time", self)
        monkeypatch.setattr(hardware.simulated.driver, "wait_until", self._wait)
        monkeypatch.setattr(hardware.clock_sync, "time", self)

    def monotonic_ns(self) -> int:
        return self.now_ns

    def time_ns(self) -> int:
        return self.now_ns + 7

    def _wait(self, due_ns: int, closed: threading.Event) -> None:
        self.now_ns = max(self.now_ns, due_ns)


def test_the_description_tells_the_settings() -> None:
    description = SimulatedDriver("bar", SimulationSettings(bits=10)).description
    assert description.name == "bar"
    assert [sensor.pixels for sensor in description.sensors] == [2048] * 4
    assert {sensor.pitch_um for sensor in description.sensors} == {12.0}
    assert (description.bits, description.markers, description.frame_rate_hz) == (10, 2, 1000.0)
    together = replace(SimulationSettings(), illumination="simultaneous")
    assert SimulatedDriver("bar", together).description.markers == 0
    wide = SimulationSettings(peaks="centroid", spot_sigma_px=3.0)
    known = SimulatedDriver("bar", wide).description
    assert (known.peaks, known.line_sigma_px, known.profile) == ("centroid", 3.0, None)


def test_frames_come_in_order_with_the_device_clock_and_end_with_the_scene() -> None:
    frames = taken(FAST)
    assert [frame.sequence for frame in frames] == list(range(50))
    assert [frame.exposure_device_ns for frame in frames] == list(range(500_000, 50_000_000, 10**6))
    host = np.array([frame.exposure_host_ns for frame in frames])
    assert (np.diff(host) == 10**6).all()
    assert [frame.marker for frame in frames[:5]] == [0, 1, 0, 1, 0]
    assert all(frame.lines.shape == (4, 2048) for frame in frames)
    assert all(frame.lines.dtype == np.uint16 for frame in frames)
    assert {frame.device for frame in frames} == {"bar"}
    assert {frame.flags for frame in frames} == {FrameFlag.NONE}


def test_the_lines_are_the_rendered_ones() -> None:
    renderer = FrameRenderer(FAST)
    rendered = np.concatenate([renderer.batch(number).lines for number in range(7)])
    for frame in taken(FAST):
        np.testing.assert_array_equal(frame.lines, rendered[frame.sequence])


def test_strobing_goes_round_all_markers() -> None:
    frames = taken(replace(FAST, scene=CalibrationTarget()))
    assert [frame.marker for frame in frames] == [number % 19 for number in range(50)]


def test_simultaneous_frames_name_no_marker() -> None:
    assert {frame.marker for frame in taken(replace(FAST, illumination="simultaneous"))} == {None}


def test_the_same_seed_gives_the_same_bits_paced_or_not() -> None:
    paced = taken(replace(FAST, realtime=True, frame_rate_hz=2000.0), 30)
    unpaced = taken(replace(FAST, frame_rate_hz=2000.0), 30)
    wanted = {frame.sequence: frame for frame in unpaced}
    compared = [frame for frame in paced if frame.sequence in wanted]
    assert len(compared) >= 1  # a stalled host may lose exposures, but keeps the first
    for frame in compared:
        np.testing.assert_array_equal(frame.lines, wanted[frame.sequence].lines)
    assert (unpaced[0].lines != taken(replace(FAST, seed=2), 1)[0].lines).mean() > 0.5


def test_no_frame_is_handed_out_before_its_exposure() -> None:
    driver = SimulatedDriver("bar", replace(FAST, realtime=True, frame_rate_hz=200.0))
    driver.open()
    started_ns = time.monotonic_ns()
    for frame in driver.frames():
        assert time.monotonic_ns() >= started_ns + frame.exposure_device_ns
    driver.close()


def test_a_frame_at_full_scale_says_so() -> None:
    bright = replace(FAST, scene=StillPoints(((0.0, 0.0, 1500.0),)), signal_electrons=1e6)
    assert {frame.flags for frame in taken(bright, 5)} == {FrameFlag.SATURATED}


def test_a_host_in_time_loses_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    Clock(monkeypatch)
    frames = taken(replace(FAST, realtime=True))
    assert [frame.sequence for frame in frames] == list(range(50))
    assert {frame.flags for frame in frames} == {FrameFlag.NONE}
    assert [f.exposure_host_ns - f.exposure_device_ns for f in frames] == [10**12 + 7] * 50


@pytest.mark.parametrize(
    ("late_s", "expected"),
    [
        (FIFO_S, 1),  # exposures 1 to 1000 wait in the memory
        (FIFO_S + 0.001, 2),  # exposure 1001 pushed out number 1
        (2.0, 1001),
        (3600.0, 3_599_001),
    ],
)
def test_a_late_host_finds_what_the_memory_holds(
    monkeypatch: pytest.MonkeyPatch, late_s: float, expected: int
) -> None:
    clock = Clock(monkeypatch)
    driver = SimulatedDriver("bar", replace(FAST, realtime=True, duration_s=None))
    driver.open()
    frames = driver.frames()
    assert next(frames).sequence == 0
    clock.now_ns += round(late_s * 1e9)
    following = list(itertools.islice(frames, 300))
    assert [frame.sequence for frame in following] == list(range(expected, expected + 300))
    lost = FrameFlag.OVERFLOW if expected > 1 else FrameFlag.NONE
    assert [frame.flags for frame in following] == [lost] + [FrameFlag.NONE] * 299
    assert following[0].exposure_device_ns == expected * 1_000_000 + 500_000
    assert following[0].marker == expected % 2
    driver.close()


def test_the_frames_after_a_loss_have_the_bits_of_their_number(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    undisturbed = taken(replace(FAST, duration_s=None), 20)
    clock = Clock(monkeypatch)
    driver = SimulatedDriver("bar", replace(FAST, realtime=True, duration_s=None))
    driver.open()
    frames = driver.frames()
    next(frames)
    clock.now_ns += round((FIFO_S + 0.012) * 1e9)
    for frame in itertools.islice(frames, 7):
        np.testing.assert_array_equal(frame.lines, undisturbed[frame.sequence].lines)
    assert frame.sequence == 19
    driver.close()


def test_the_last_frames_wait_for_a_host_that_comes_after_the_end(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clock = Clock(monkeypatch)
    driver = SimulatedDriver("bar", replace(FAST, realtime=True, duration_s=3.0))
    driver.open()
    frames = driver.frames()
    next(frames)
    clock.now_ns += 10**11
    assert [frame.sequence for frame in frames] == list(range(2000, 3000))


def test_close_from_another_thread_ends_a_waiting_host_at_once() -> None:
    """The first exposure is 50 s away."""
    driver = SimulatedDriver("bar", SimulationSettings(frame_rate_hz=0.01))
    driver.open()
    got: list[LineFrame] = []
    reader = threading.Thread(target=lambda: got.extend(driver.frames()), daemon=True)
    reader.start()
    driver.close()
    driver.close()
    reader.join(timeout=240.0)
    assert not reader.is_alive()
    assert got == []


def test_close_ends_a_run_of_frames_in_between() -> None:
    driver = SimulatedDriver("bar", replace(FAST, duration_s=None))
    driver.open()
    frames = driver.frames()
    next(frames)
    driver.close()
    assert list(frames) == []


def test_opened_again_it_starts_anew_and_ends_the_old_run() -> None:
    driver = SimulatedDriver("bar", replace(FAST, duration_s=None))
    driver.open()
    old = driver.frames()
    first = [next(old) for _ in range(3)]
    driver.open()
    new = driver.frames()
    again = [next(new) for _ in range(3)]
    assert list(old) == []
    assert [frame.sequence for frame in again] == [0, 1, 2]
    for one, other in zip(first, again, strict=True):
        np.testing.assert_array_equal(one.lines, other.lines)
    driver.close()


def test_frames_before_open_are_an_error() -> None:
    with pytest.raises(RuntimeError, match="call open"):
        SimulatedDriver("bar", FAST).frames()
