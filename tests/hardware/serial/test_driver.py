"""SerialDriver with a simulated device and transmission faults."""

import math
import os
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from hardware.clock_sync import DeviceClock
from hardware.errors import DeviceChanged, DeviceNotConnected
from hardware.line_frame import FrameFlag, LineFrame
from hardware.link import LinkedDriver, LinkState
from hardware.recording.writer import RecordingWriter
from hardware.serial import emulator, link_watchdog, simulated_device
from hardware.serial.codec import encode
from hardware.serial.driver import SerialDriver, check_identity
from hardware.serial.emulator import serve_terminal
from hardware.serial.frame_builder import ExposureAssembler
from hardware.serial.messages import Description, Lines, Result
from hardware.serial.settings import SerialSettings
from hardware.serial.simulated_device import SimulatedSerialDevice
from hardware.simulated.driver import FrameRenderer
from hardware.simulated.settings import SimulationSettings
from hardware.strobe_schedule import StrobeSchedule
from service.pipeline.detection_stage import peak_method
from tests.hardware.serial.emulated_device import (
    BenchDevice,
    bench_device,
    every_third,
    garbage,
    halves,
    silent,
)


def first_exposure(frame: LineFrame, rendered: NDArray[np.uint16]) -> int:
    """Which exposure of the device the first frame shows: a busy host may lose those before."""
    (number,) = np.flatnonzero((rendered == frame.lines).all(axis=(1, 2)))
    return int(number)


class Watched:
    """A driver whose frames a thread takes, and whose states are kept."""

    def __init__(self, settings: SerialSettings) -> None:
        self.driver = SerialDriver("bar", settings)
        self.frames: list[LineFrame] = []
        self.states: list[LinkState] = []
        self.error: Exception | None = None
        self.driver.listen(self.states.append)
        self.driver.open()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        try:
            self.frames.extend(self.driver.frames())
        except Exception as error:  # noqa: BLE001
            self.error = error

    def wait(self, condition: Callable[[], bool], seconds: float = 240.0) -> None:
        end = time.monotonic() + seconds
        while not condition():
            assert time.monotonic() < end, f"it did not come true: {self.driver.link()}"
            assert self._thread.is_alive() or self.error is not None
            time.sleep(0.001)

    def more(self, count: int) -> None:
        wanted = self.driver.link().counters.frames_received + count
        self.wait(lambda: self.driver.link().counters.frames_received >= wanted)

    def state(self, name: str) -> LinkState:
        self.wait(lambda: self.driver.link().state == name)
        return self.driver.link()

    def end(self) -> None:
        self.driver.close()
        self._thread.join(240.0)
        assert not self._thread.is_alive()


@pytest.fixture
def bar() -> Iterator[BenchDevice]:
    with bench_device() as device:
        yield device


@pytest.fixture
def watched(bar: BenchDevice) -> Iterator[Watched]:
    watched = Watched(bar.status())
    yield watched
    watched.end()


def test_it_is_what_the_device_says_it_is(bar: BenchDevice) -> None:
    driver = SerialDriver("bar", bar.status(frame_rate_hz=250.0))
    assert isinstance(driver, LinkedDriver)
    assert driver.link().state == "disconnected"
    driver.open()
    description = driver.description
    said = bar.device.description()
    assert description.name == "bar"
    assert [sensor.name for sensor in description.sensors] == list(said.sensors)
    assert {sensor.pixels for sensor in description.sensors} == {2048}
    assert (description.frame_rate_hz, description.bits, description.markers) == (250.0, 12, 2)
    assert description.line_sigma_px == pytest.approx(said.line_sigma_px)
    driver.close()
    driver.close()


def test_how_peaks_are_measured_is_told_and_not_said_by_the_device(bar: BenchDevice) -> None:
    for status, expected in ((bar.status(), "fit"), (bar.status(peaks="centroid"), "centroid")):
        driver = SerialDriver("bar", status)
        driver.open()
        assert driver.description.peaks == expected
        assert peak_method(driver.description) == expected
        driver.close()
    with pytest.raises(InvalidParameter, match="peaks is 'best'"):
        bar.status(peaks="best")


def test_frames_are_the_devices_own(bar: BenchDevice, watched: Watched, tmp_path: Path) -> None:
    watched.more(20)
    watched.end()
    rendered = FrameRenderer(bar.settings).batch(0).lines
    numbers = [frame.sequence for frame in watched.frames]
    assert numbers == list(range(len(numbers)))
    first = first_exposure(watched.frames[0], rendered)
    for frame in watched.frames:
        assert np.array_equal(frame.lines, rendered[(first + frame.sequence) % 8])
        assert frame.marker == (first + frame.sequence) % 2
        assert abs(time.time_ns() - frame.exposure_host_ns) < 60e9
    steps = np.diff([frame.exposure_device_ns for frame in watched.frames])
    assert steps == pytest.approx(np.full(len(steps), 2e6), abs=2e3)
    with RecordingWriter(tmp_path / "bar.h5", watched.driver.description) as writer:
        for frame in watched.frames:
            writer.append(frame)


UNPLUGGED = int(os.environ.get("LUMILINE_TEST_UNPLUGS", "10"))
"""How often the device is unplugged; a hundred times take seven seconds."""


def test_the_link_has_the_rate_error_of_the_devices_clock_once_it_is_known(
    watched: Watched, monkeypatch: pytest.MonkeyPatch
) -> None:
    watched.more(1)
    monkeypatch.setattr(DeviceClock, "rate", property(lambda _: 50e-6))
    monkeypatch.setattr(DeviceClock, "uncertainty_ns", property(lambda _: math.inf))
    assert watched.driver.link().clock_rate_ppm is None
    monkeypatch.setattr(DeviceClock, "uncertainty_ns", property(lambda _: 2000.0))
    found = watched.driver.link()
    assert found.clock_rate_ppm == pytest.approx(50.0)
    assert found.clock_uncertainty_us == pytest.approx(2.0)


@pytest.mark.slow
def test_it_comes_back_each_time_it_is_unplugged(bar: BenchDevice, watched: Watched) -> None:
    for _ in range(UNPLUGGED):
        watched.more(3)
        bar.unplug()
        watched.wait(lambda: watched.driver.link().state == "disconnected")
        bar.plug()
        watched.wait(lambda: watched.driver.link().state == "connected")
    watched.more(3)
    watched.end()
    assert watched.error is None
    counters = watched.driver.link().counters
    assert counters.reconnects == UNPLUGGED
    # It stayed switched on: its exposures meanwhile are known to be lost, its clock went on.
    assert counters.clock_restarts == 0
    numbers = [frame.sequence for frame in watched.frames]
    assert counters.frames_lost == numbers[-1] + 1 - len(numbers) > 0
    assert np.all(np.diff(numbers) > 0)
    assert np.all(np.diff([frame.exposure_device_ns for frame in watched.frames]) > 0)
    gone = [state for state in watched.states if state.state == "disconnected"]
    assert len(gone) >= UNPLUGGED
    assert all("trying again" in (state.reason or "") for state in gone)
    assert len({thread.name for thread in threading.enumerate()}) < 20


@pytest.mark.parametrize(
    ("line", "state", "words"),
    [
        (silent, "silent", "nothing came for 0.1 s"),
        (garbage, "garbled", "no whole frame"),
        (halves, "garbled", "no whole frame"),
    ],
)
def test_what_a_bad_line_does_is_told_and_passes(
    bar: BenchDevice, watched: Watched, line: Callable[[bytes], bytes], state: str, words: str
) -> None:
    watched.more(3)
    bar.line = line
    status = watched.state(state)
    assert words in (status.reason or "")
    garbled = watched.driver.link().counters.frames_garbled
    if state == "garbled":
        assert garbled > 0
    bar.line = lambda data: data
    assert watched.state("connected").reason is None
    watched.more(3)
    watched.end()
    assert watched.error is None
    assert watched.driver.link().counters.reconnects == 0


def test_damaged_messages_cost_their_frames_only(bar: BenchDevice, watched: Watched) -> None:
    watched.more(3)
    bar.line = every_third
    watched.wait(lambda: watched.driver.link().counters.frames_garbled > 20)
    bar.line = lambda data: data
    watched.more(3)
    watched.end()
    rendered = FrameRenderer(bar.settings).batch(0).lines
    # Numbers count from the first frame that arrived, which need not be the device's first.
    first = first_exposure(watched.frames[0], rendered)
    for frame in watched.frames:
        assert np.array_equal(frame.lines, rendered[(first + frame.sequence) % 8])
    counters = watched.driver.link().counters
    assert counters.frames_lost >= 20
    assert any(frame.flags & FrameFlag.OVERFLOW for frame in watched.frames)


def test_a_device_that_is_reset_is_told_anew_and_its_clock_goes_on(bar: BenchDevice) -> None:
    status = bar.status(frame_rate_hz=400.0, strobe=StrobeSchedule((1, 1, 0)))
    watched = Watched(status)
    for _ in range(3):
        watched.more(10)
        bar.switch_off_and_on()
        time.sleep(0.01)
    watched.more(10)
    watched.end()
    counters = watched.driver.link().counters
    assert counters.clock_restarts == 3
    assert np.all(np.diff([frame.sequence for frame in watched.frames]) > 0)
    times = np.array([frame.exposure_device_ns for frame in watched.frames])
    assert np.all(np.diff(times) > 0)
    host = np.array([frame.exposure_host_ns for frame in watched.frames])
    # The device's clock, counted on, goes along with the host's over the resets.
    assert np.ptp(host - times) < 0.2e9
    rate = 1e9 / np.median(np.diff(times))
    assert rate == pytest.approx(400.0, rel=0.01)
    assert {frame.marker for frame in watched.frames} == {0, 1}


def test_another_device_in_its_place_is_not_taken_for_it(
    bar: BenchDevice, watched: Watched
) -> None:
    watched.more(3)
    bar.unplug()
    watched.state("disconnected")
    bar.described = lambda said: replace(said, sensors=("a", "b"), pixels=8)
    bar.switch_off_and_on()
    bar.plug()
    watched.wait(lambda: watched.error is not None)
    assert isinstance(watched.error, DeviceChanged)
    assert "with the sensors a, b of 8 px; before there were vertical" in watched.error.detail
    assert {state.state for state in watched.states} == {
        "disconnected"
    }  # it never became "connected"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"electrons_per_count": 3.0}, "with the gain 3 electrons per count; before it was"),
        ({"bits": 16}, "with the conversion 16 bits; before it was 12 bits"),
        ({"read_noise_electrons": 1.0}, "with the read noise 1 "),
        ({"offset_counts": 1.0}, "with the offset 1 counts"),
        ({"pitch_um": 8.0}, "with the pixel pitch 8 um; before it was 14 um"),
        ({"line_sigma_px": 9.0}, "with the line width 9 px"),
    ],
)
def test_other_values_than_are_computed_with_are_another_device(
    change: dict[str, Any], words: str
) -> None:
    said = Description("bar", ("a",), 8, 14.0, 1_000_000, line_sigma_px=1.5)
    check_identity(said, replace(said, name="other", clock_hz=5, delay_us=3.0, frame_rate_hz=7.0))
    with pytest.raises(DeviceChanged, match=words):
        check_identity(said, replace(said, **change))


def test_a_device_with_another_clock_goes_on_and_with_another_gain_does_not(
    bar: BenchDevice, watched: Watched, monkeypatch: pytest.MonkeyPatch
) -> None:
    watched.more(20)
    monkeypatch.setattr(simulated_device, "CLOCK_HZ", 10_000_000)
    bar.switch_off_and_on()
    watched.wait(lambda: watched.driver.link().counters.clock_restarts == 1)
    watched.more(20)
    bar.described = lambda said: replace(said, electrons_per_count=3.0)
    bar.switch_off_and_on()
    watched.wait(lambda: watched.error is not None)
    assert isinstance(watched.error, DeviceChanged)
    steps = np.diff([frame.exposure_device_ns for frame in watched.frames[-15:]])
    assert steps == pytest.approx(np.full(len(steps), 2e6), abs=2e3)


class BusyDevice:
    """Makes all simulated devices answer so many commands with "busy"."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.left = 0
        self.status: list[str] = []
        obey = SimulatedSerialDevice._result_of

        def done(device: SimulatedSerialDevice, command: Any, now_ns: int) -> Result:
            self.status.append(type(command).__name__)
            if self.left > 0:
                self.left -= 1
                return Result.BUSY
            return obey(device, command, now_ns)

        monkeypatch.setattr(SimulatedSerialDevice, "_result_of", done)
        monkeypatch.setattr("hardware.serial.connection.RETRY_INTERVAL_NS", 20_000_000)
        monkeypatch.setattr("hardware.serial.connection.RETRY_INTERVAL_NS", 20_000_000)


@pytest.fixture
def busy(monkeypatch: pytest.MonkeyPatch) -> BusyDevice:
    return BusyDevice(monkeypatch)


def test_a_busy_device_is_waited_for(bar: BenchDevice, busy: BusyDevice) -> None:
    """When it is opened, and when it was reset."""
    busy.left = 3
    watched = Watched(bar.status(frame_rate_hz=400.0))
    watched.more(3)
    busy.left = 3
    bar.switch_off_and_on()
    watched.wait(lambda: watched.driver.link().counters.clock_restarts == 1)
    watched.more(3)
    watched.end()
    assert watched.error is None
    assert watched.driver.link().counters.reconnects == 0
    assert busy.left == 0


def test_a_device_that_stays_busy_is_tried_again_as_one_that_is_lost(
    bar: BenchDevice, busy: BusyDevice, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("hardware.serial.connection.BUSY_LIMIT_NS", 100_000_000)
    busy.left = 60
    with pytest.raises(DeviceNotConnected, match="the device is busy for"):
        SerialDriver("bar", bar.status()).open()
    busy.left = 0
    watched = Watched(bar.status())
    watched.more(3)
    busy.left = 60
    bar.switch_off_and_on()
    assert "the device is busy for" in (watched.state("disconnected").reason or "")
    busy.left = 0
    watched.more(3)
    watched.end()
    assert watched.error is None
    assert watched.driver.link().counters.reconnects == 1


def test_a_device_that_rests_is_silent_and_told_anew_after_a_reset(
    bar: BenchDevice, busy: BusyDevice, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("hardware.serial.link_watchdog.DESCRIBE_INTERVAL_NS", 20_000_000)
    watched = Watched(bar.status())
    watched.more(3)
    monkeypatch.setattr(SimulatedSerialDevice, "_lines", lambda *_: iter(()))
    monkeypatch.setattr(simulated_device, "STATUS_NS", 50_000_000)
    monkeypatch.setattr("hardware.serial.link_watchdog.MESSAGES_NS", 200_000_000)
    watched.wait(lambda: "it rests" in (watched.driver.link().reason or ""))
    assert watched.driver.link().counters.frames_garbled == 0
    status = busy.status.count("Start")
    bar.switch_off_and_on()
    watched.wait(lambda: busy.status.count("Start") > status)
    watched.end()
    assert {state.state for state in watched.states} == {"silent"}


def test_what_a_device_says_when_it_was_reset_is_taken(bar: BenchDevice, watched: Watched) -> None:
    """Three exposures of 20 Hz are waited for."""
    watched.more(3)
    bar.described = lambda said: replace(said, frame_rate_hz=20.0)
    bar.switch_off_and_on()
    watched.wait(lambda: watched.driver.link().counters.clock_restarts == 1)
    bar.line = silent
    assert "for 0.15 s" in (watched.state("silent").reason or "")


def test_a_device_that_cannot_be_told_any_more_is_told_so(bar: BenchDevice) -> None:
    watched = Watched(bar.status(frame_rate_hz=400.0))
    watched.more(3)
    bar.described = lambda said: replace(said, abilities=type(said.abilities)(0))
    bar.switch_off_and_on()
    watched.wait(lambda: watched.error is not None)
    assert isinstance(watched.error, InvalidParameter)
    assert "does not support the setting of frame_rate_hz" in watched.error.detail


def test_what_is_wrong_with_its_messages_is_told(bar: BenchDevice, watched: Watched) -> None:
    wrong = encode(replace(bar.device.description(), electrons_per_count=0.0))
    watched.more(3)
    bar.line = lambda _: wrong
    reason = watched.state("garbled").reason or ""
    assert (
        reason == "a description came with gain 0; it must be above 0; check the device's firmware"
    )


def test_device_whose_numbers_stand_still_is_not_connected(
    bar: BenchDevice, watched: Watched, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its frames go on; when the numbers count again, it is connected after a while."""
    add = ExposureAssembler.add

    def add_with_number(self: ExposureAssembler, part: Lines) -> Lines | None:
        exposed = add(self, part)
        return None if exposed is None else replace(exposed, sequence=2**31)

    watched.more(3)
    monkeypatch.setattr(link_watchdog, "IRREGULAR_NS", 500_000_000)
    monkeypatch.setattr(ExposureAssembler, "add", add_with_number)
    assert "their numbers or ticks began anew" in (watched.state("garbled").reason or "")
    watched.more(3)
    monkeypatch.setattr(ExposureAssembler, "add", add)
    watched.state("connected")
    assert watched.driver.link().counters.frames_lost == 0


def test_a_description_out_of_bounds_is_told(
    bar: BenchDevice, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("hardware.serial.connection.DESCRIBE_S", 0.2)
    bar.described = lambda said: replace(said, electrons_per_count=0.0)
    bar.switch_off_and_on()
    with pytest.raises(DeviceNotConnected, match="a description came with gain 0; it must be abov"):
        SerialDriver("bar", bar.status()).open()


def test_a_strobe_schedule_is_obeyed(bar: BenchDevice) -> None:
    watched = Watched(bar.status(strobe=StrobeSchedule((0, 0, 1))))
    watched.more(30)
    watched.end()
    assert watched.driver.description.markers == 2
    simulated = replace(bar.settings, strobe=StrobeSchedule((0, 0, 1)))
    rendered = FrameRenderer(simulated).batch(0).lines
    first = first_exposure(watched.frames[0], rendered)
    schedule = [(0, 0, 1)[(first + frame.sequence) % 3] for frame in watched.frames]
    assert [frame.marker for frame in watched.frames] == schedule


def test_all_markers_at_once_are_a_schedule_too(bar: BenchDevice) -> None:
    watched = Watched(bar.status(strobe=StrobeSchedule((None,))))
    watched.more(5)
    watched.end()
    assert watched.driver.description.markers == 0
    assert {frame.marker for frame in watched.frames} == {None}


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"frame_rate_hz": 50_000.0}, "refused the command exposure .* it cannot do that"),
        ({"strobe": StrobeSchedule((0, 5))}, "lights 6 markers; simulated-bar has 2"),
        ({"strobe": StrobeSchedule((0, None))}, "refused the command strobe"),
    ],
)
def test_what_the_device_cannot_do_is_refused(
    bar: BenchDevice, changes: dict[str, object], words: str
) -> None:
    driver = SerialDriver("bar", bar.status(**changes))
    with pytest.raises(InvalidParameter, match=words):
        driver.open()


def test_a_device_that_takes_no_commands_is_not_given_any() -> None:
    with bench_device() as bar:
        bar.described = lambda said: replace(said, abilities=type(said.abilities)(0))
        bar.switch_off_and_on()
        with pytest.raises(InvalidParameter, match="does not support the setting of frame_rate_hz"):
            SerialDriver("bar", bar.status(frame_rate_hz=10.0)).open()
        with pytest.raises(InvalidParameter, match="does not support the setting of strobe"):
            SerialDriver("bar", bar.status(strobe=StrobeSchedule((0,)))).open()
        driver = SerialDriver("bar", bar.status())
        driver.open()
        driver.close()


def test_parts_of_exposures_are_put_together() -> None:
    with bench_device(part_counts=1000) as bar:
        watched = Watched(bar.status())
        watched.more(10)
        watched.end()
        rendered = FrameRenderer(bar.settings).batch(0).lines
        first = first_exposure(watched.frames[0], rendered)
        for frame in watched.frames:
            assert np.array_equal(frame.lines, rendered[(first + frame.sequence) % 8])


@pytest.mark.parametrize(
    ("url", "words"),
    [
        ("/dev/ttyLumilineNowhere", "No such file"),
        ("socket://127.0.0.1:1", "refused"),
        ("socket://127.0.0.1:99999", "0-65535"),
        ("rfc2217://127.0.0.1:1", "rfc2217://127.0.0.1:1 cannot be opened"),
    ],
)
def test_a_port_that_is_not_there_is_told(url: str, words: str) -> None:
    with pytest.raises(DeviceNotConnected, match=words):
        SerialDriver("bar", SerialSettings(url)).open()


@pytest.mark.parametrize(
    ("line", "words"), [(silent, "nothing comes"), (garbage, "not the line-scan protocol")]
)
def test_a_port_without_a_device_is_told(
    bar: BenchDevice, line: Callable[[bytes], bytes], words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("hardware.serial.connection.DESCRIBE_S", 0.2)
    bar.line = line
    with pytest.raises(DeviceNotConnected, match=words):
        SerialDriver("bar", bar.status()).open()


@pytest.mark.parametrize("line", [silent, lambda data: data])
def test_close_ends_a_waiting_read_at_once(
    bar: BenchDevice, line: Callable[[bytes], bytes]
) -> None:
    watched = Watched(SerialSettings(bar.url, silent_after_s=60.0))
    bar.line = line
    watched.driver.close()
    watched._thread.join(20.0)  # a read waits 30 s
    assert not watched._thread.is_alive()


def test_close_ends_an_opening_at_once(bar: BenchDevice, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hardware.serial.connection.DESCRIBE_S", 60.0)
    monkeypatch.setattr("hardware.serial.connection._ASK_AGAIN_S", 60.0)
    bar.line = silent
    driver = SerialDriver("bar", bar.status())
    closer = threading.Timer(0.1, driver.close)
    closer.start()
    with pytest.raises(DeviceNotConnected):
        driver.open()
    closer.join()


def test_it_can_be_opened_again(bar: BenchDevice) -> None:
    driver = SerialDriver("bar", bar.status())
    with pytest.raises(RuntimeError, match="open"):
        driver.frames()
    for _ in range(3):
        driver.open()
        assert next(driver.frames()).sequence == 0
        driver.close()


@pytest.mark.slow
def test_what_the_device_says_of_its_temperature_is_kept(
    bar: BenchDevice, watched: Watched
) -> None:
    watched.wait(lambda: watched.driver.link().temperature_c == 25.0)


@pytest.mark.slow
def test_a_pseudo_terminal_is_a_port(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # A host that does not read for a quarter of a second, as on a busy machine, loses data.
    monkeypatch.setattr(emulator, "_SEND_S", 240.0)
    link, ended, named = tmp_path / "port", threading.Event(), threading.Event()
    # Slowly: a terminal's buffer is small, and a busy machine would overflow it.
    settings = SimulationSettings(frame_rate_hz=25.0)
    server = threading.Thread(
        target=serve_terminal,
        args=(
            lambda now: SimulatedSerialDevice(settings, now, rendered=8),
            link,
            ended,
            lambda _: named.set(),
        ),
    )
    server.start()
    try:
        assert named.wait(240.0)
        for _ in range(3):  # the port stays, and can be opened again
            watched = Watched(SerialSettings(str(link.resolve())))
            watched.more(10)
            watched.end()
            assert watched.error is None
            assert watched.driver.link().counters.frames_garbled == 0
        ended.set()
        server.join()
        with pytest.raises(DeviceNotConnected):
            SerialDriver("bar", SerialSettings("/dev/pts/99999")).open()
    finally:
        ended.set()
        server.join()


@pytest.mark.parametrize(
    "url",
    ["/etc/passwd", "/dev/sda", "/dev/../etc/passwd", "/dev/tty/../sda", "spy:///dev/ttyS0?file=x",
     "loop://", "socket://host", "socket://user@host:1", "http://host:1", "/dev/serial/by-id/.."],
)  # fmt: skip
def test_other_files_and_urls_are_not_opened(url: str) -> None:
    with pytest.raises(InvalidParameter, match="url is"):
        SerialSettings(url)


@pytest.mark.parametrize(
    "url",
    ["/dev/ttyACM0", "/dev/serial/by-id/usb-Bar_0017-if00", "/dev/pts/3", "/dev/lumiline-bar",
     "COM3", "socket://bar.local:5000", "rfc2217://10.0.0.2:2217"],
)  # fmt: skip
def test_ports_by_their_usual_names(url: str) -> None:
    assert SerialSettings(url).url == url
