"""FusionDriver: its bars come, go and change; its frames, its link, and what is refused."""

import pickle
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from compute.errors import InvalidParameter
from compute.reconstruction.point_batch import PointBatch
from hardware.driver import DeviceDescription, SensorDescription
from hardware.errors import DeviceNotConnected
from hardware.line_frame import LineFrame
from hardware.link import LinkedDriver
from service.pipeline.device_status import DeviceStatus
from service.pipeline.frame_batch import FrameBatch
from service.pipeline.fusion import driver as driver_module
from service.pipeline.fusion.driver import FusionDriver
from service.pipeline.fusion.fused_frame import FusedFrame
from service.pipeline.fusion.settings import FusedBar, FusionSettings
from service.pipeline.interface import DeviceUser
from tests.service.pipeline.fusion.two_bars import PERIOD_NS, bar_frame

BARS = ("left", "right")
SENSORS = tuple(SensorDescription(f"s{number}", 2048, 12.0) for number in range(4))


class Bar:
    """A running device that gives what the test says."""

    def __init__(self, name: str) -> None:
        self.device_id = name
        self.description = DeviceDescription(
            name, SENSORS, 1e9 / PERIOD_NS, 12, 10.0, 20.0, 60.0, 1
        )
        self.connected = True
        self.taps: list[Any] = []

    def status(self) -> DeviceStatus:
        return DeviceStatus("disconnected", "it is unplugged")

    def attach(self, tap: Any, *, sampled: bool = False) -> None:
        assert not tap.wants_pixels
        assert not sampled
        self.taps.append(tap)

    def detach(self, tap: Any) -> None:
        self.taps.remove(tap)

    def see(self, numbers: range) -> None:
        """Process exposures of the oracle's hall."""
        for number in numbers:
            index = BARS.index(self.device_id)
            one = bar_frame(index, number * PERIOD_NS + index * 600_000, 0.0)
            frame = replace(one.frame, lines=np.zeros((4, 2048), np.uint16), host_sigma_ns=3e3)
            batch = FrameBatch(
                self.device_id,
                tuple(sensor.name for sensor in SENSORS),
                None,
                None,
                (frame,),
                one.peaks,
                PointBatch.empty(4),
                np.empty(0, dtype=np.intp),
            )
            for tap in self.taps:
                tap.offer(batch)


class Hall:
    """The devices that the driver is bound to, and the driver."""

    def __init__(self) -> None:
        self.bars: dict[str, Bar] = {}
        bars = [FusedBar(name, SENSORS) for name in BARS]
        self.driver = FusionDriver("hall", bars, FusionSettings(max_wait_ms=10_000.0))
        self.driver.bind(self)

    def known_session(self, device_id: str) -> Any:
        return self.bars.get(device_id)

    def start(self, name: str) -> Bar:
        self.bars[name] = Bar(name)
        return self.bars[name]

    def look(self, frames: Iterator[LineFrame], seen_by: Bar, numbers: range) -> list[FusedFrame]:
        """See exposures, and return as many frames as there are of these."""
        time.sleep(driver_module.LOOK_S)
        seen_by.see(numbers)
        found = []
        for _ in numbers:
            frame = next(frames)
            assert isinstance(frame, FusedFrame)
            found.append(frame)
        return found


@pytest.fixture
def hall(monkeypatch: pytest.MonkeyPatch) -> Iterator[Hall]:
    # Looked for at each turn; and nobody is silent: machines may be busy.
    monkeypatch.setattr(driver_module, "LOOK_S", 1e-3)
    monkeypatch.setattr(driver_module, "SILENT_S", 1e6)
    made = Hall()
    yield made
    made.driver.close()


def test_it_is_a_linked_driver_that_uses_devices_and_can_be_pickled(hall: Hall) -> None:
    assert isinstance(hall.driver, LinkedDriver)
    assert isinstance(hall.driver, DeviceUser)
    again = pickle.loads(pickle.dumps(hall.driver))
    assert again.description == hall.driver.description
    names = [sensor.name for sensor in again.description.sensors]
    assert names == [f"{bar}.s{number}" for bar in BARS for number in range(4)]


def test_without_any_bar_it_cannot_be_opened(hall: Hall) -> None:
    with pytest.raises(DeviceNotConnected, match='"left" is away: it was not started'):
        hall.driver.open()
    hall.start("left").connected = False
    with pytest.raises(DeviceNotConnected, match="unplugged"):
        hall.driver.open()


def test_frames_of_both(hall: Hall) -> None:
    left, right = hall.start("left"), hall.start("right")
    hall.driver.open()
    assert hall.driver.description.frame_rate_hz == left.description.frame_rate_hz
    assert hall.driver.description.readout == "bar-peaks"
    frames = hall.driver.frames()
    right.see(range(8))
    left.see(range(6))
    found = [next(frames) for _ in range(6)]
    last = found[-1]
    assert isinstance(last, FusedFrame)
    assert np.isfinite(last.peaks.position_px[:, 0]).all()
    assert last.lines.shape == (8, 0)
    # Both bars' own, and what is stated beyond.
    expected = np.hypot(np.hypot(3e-6, 3e-6), 50e-6)
    np.testing.assert_allclose(last.clock_sigma_s, expected)
    assert hall.driver.link().state == "connected"
    assert hall.driver.link().reason is None
    hall.driver.close()
    assert next(frames, None) is None
    assert left.taps == right.taps == []


@pytest.mark.slow
def test_a_bar_goes_and_comes_again(hall: Hall) -> None:
    left, right = hall.start("left"), hall.start("right")
    hall.driver.open()
    frames = hall.driver.frames()
    right.see(range(4))
    left.see(range(2))
    next(frames)
    right.connected = False
    alone = hall.look(frames, left, range(4, 8))
    assert np.isfinite(alone[-1].peaks.position_px[:, 0]).sum() == 4
    link = hall.driver.link()
    assert link.state == "connected"
    assert link.reason == '"right" is away: it is disconnected (it is unplugged)'
    # Started again, it is another session of the pipeline.
    again = hall.start("right")
    time.sleep(driver_module.LOOK_S)
    left.see(range(8, 9))
    while not again.taps:
        left.see(range(9, 10))
        next(frames)
    again.see(range(10, 16))
    left.see(range(11, 14))
    together = next(frames)
    while together.sequence < 5 or not np.isfinite(together.peaks.position_px[:, 0]).all():
        together = next(frames)
    assert hall.driver.link().reason is None


def test_a_bar_with_other_sensors_is_left_out(hall: Hall) -> None:
    left, right = hall.start("left"), hall.start("right")
    right.description = replace(right.description, sensors=SENSORS[:3])
    hall.driver.open()
    frames = hall.driver.frames()
    alone = hall.look(frames, left, range(3))
    assert np.isfinite(alone[-1].peaks.position_px[:, 0]).sum() == 4
    assert "it has other sensors now" in str(hall.driver.link().reason)


def test_a_bar_that_is_silent_is_left_out(hall: Hall, monkeypatch: pytest.MonkeyPatch) -> None:
    left, right = hall.start("left"), hall.start("right")
    hall.driver.open()
    frames = hall.driver.frames()
    right.see(range(6))
    left.see(range(3))
    next(frames)
    monkeypatch.setattr(driver_module, "_silent_s", lambda device: 1e6 * (device is left))
    time.sleep(0.01)
    alone = hall.look(frames, left, range(6, 9))
    assert np.isfinite(alone[-1].peaks.position_px[:, 0]).sum() == 4
    assert hall.driver.link().reason == '"right" is away: no frames come from it'
    monkeypatch.setattr(driver_module, "_silent_s", lambda _: 1e6)
    # By itself: it need not be looked for.
    right.see(range(8, 16))
    left.see(range(9, 12))
    while not np.isfinite(next(frames).peaks.position_px[:, 0]).all():
        pass


@pytest.mark.parametrize("names", [("left",), ("left", "left"), ("left", "hall")])
def test_bars_that_are_not_two_are_refused(names: tuple[str, ...]) -> None:
    with pytest.raises(InvalidParameter, match="two devices or more"):
        FusionDriver("hall", [FusedBar(name, SENSORS) for name in names], FusionSettings())


def test_sensors_of_different_lengths_are_refused() -> None:
    other = tuple(replace(sensor, pixels=1024) for sensor in SENSORS)
    with pytest.raises(InvalidParameter, match="1024, 2048 pixels"):
        FusionDriver(
            "hall", [FusedBar("left", SENSORS), FusedBar("right", other)], FusionSettings()
        )
