"""StationMirror: clients have a batch before taps, and taps before what is said behind it."""

from typing import Any, cast

from service.pipeline.active_calibration import NO_ACTIVE_CALIBRATION, ActiveCalibration
from service.pipeline.device_status import DeviceStatus
from service.pipeline.frame_batch import FrameBatch, LatestPoses
from service.station.bus_messages import (
    BatchMessage,
    DeviceFigures,
    StationFigures,
    batch_message,
    figures_message,
)
from service.station.station_mirror import StationMirror
from tests.service.protocols.stream.test_hub import frames_of
from tests.service.station.test_bus_messages import DESCRIPTION


class Log:
    """Streams and a tap that write down what they are given, in order."""

    wants_pixels = True

    def __init__(self) -> None:
        self.events: list[tuple[str, int, int]] = []

    def publish_message(self, message: BatchMessage) -> None:
        """Take a batch for the clients."""
        self.events.append(("clients", message.first_sequence, 0))

    def prepare(self, _found: ActiveCalibration) -> None:
        """Take what batches are processed with."""

    def offer(self, batch: FrameBatch) -> None:
        """Take a batch as a tap."""
        frame = batch.frames[0]
        self.events.append(("tap", frame.sequence, frame.lines.size))

    def __getattr__(self, _name: str) -> Any:
        return lambda *_, **__: 0


class Mirror(StationMirror):
    """A mirror whose station is played by hand."""

    def call(self, method: str, *_args: Any, **_members: Any) -> Any:
        """Answer nothing."""

    def notify(self, method: str, *args: Any) -> None:
        """Do nothing."""

    def calibration(self, device_id: str) -> ActiveCalibration:
        """Return none."""
        return NO_ACTIVE_CALIBRATION

    def _comes_back(self, device_id: str) -> bool:
        return False

    def _take_calibration(self, *header: Any) -> None:
        """Prepare no tap."""

    def say(self, *messages: bytes) -> None:
        """Take messages, as those that are read in one go."""
        for message in messages:
            self._take(message)

    def end_turn(self) -> None:
        """Do what is done once the clients have had their turn."""
        self._offer()


def figures(generation: int) -> bytes:
    one = DeviceFigures(DeviceStatus("running"), generation, DESCRIPTION, True, True)
    return figures_message(StationFigures({"d": one}))


def mirror_with_tap() -> tuple[Mirror, Log]:
    log = Log()
    mirror = Mirror(cast("Any", log), LatestPoses())
    mirror.say(figures(1))
    device = mirror._devices["d"]
    device.attach(cast("Any", log))
    device.prepare(next(iter(device.taps)), NO_ACTIVE_CALIBRATION)
    return mirror, log


def batch(sequence: int) -> bytes:
    return batch_message(frames_of(range(sequence, sequence + 1)), pixels=True)


def test_taps_are_offered_batches_with_pixels_behind_the_clients() -> None:
    mirror, log = mirror_with_tap()
    mirror.say(batch(1), batch(2))
    assert log.events == [("clients", 1, 0), ("clients", 2, 0)]
    mirror.end_turn()
    assert log.events[2:] == [("tap", 1, 16), ("tap", 2, 16)]
    mirror.end_turn()
    assert len(log.events) == 4


def test_taps_have_a_batch_before_what_is_said_behind_it() -> None:
    """Such as that the device was started anew: what came before is of the old start."""
    mirror, log = mirror_with_tap()
    mirror.say(batch(1), figures(2), batch(2))
    mirror.end_turn()
    assert log.events == [("clients", 1, 0), ("tap", 1, 16), ("clients", 2, 0)]
