"""Readings of a waved wand with strobed markers, from a recording or a running device."""

import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from compute.calibration.self_calibration.strobed_poses import StrobedReadings, strobed_poses
from compute.camera.model import SensorGeometry
from compute.errors import InvalidParameter
from lumiline.client import Client
from lumiline.client.messages import Frame, Hello
from service.cli.observations_csv import ReadingTable

if TYPE_CHECKING:
    from collections.abc import Mapping

Array = NDArray[np.float64]

UNCLEAR_FLAGS: Final = frozenset({"saturated", "clipped", "merged", "unfitted", "ambiguous"})
"""Flags of peaks whose position is not that of one marker alone; as ``taps.UNCLEAR``."""
BUNDLE_MS: Final = 50.0


def read_recorded_wand(
    path: Path, markers: Sequence[int], done: Callable[[float], None]
) -> tuple[ReadingTable, tuple[SensorGeometry, ...]]:
    """Return the poses of a wand in a recording of line scans, and the device's sensors.

    Args:
        path: HDF5 file.
        markers: strobed markers of the wand, in its order.
        done: called with the share of the frames processed.

    Raises:
        InvalidParameter: the markers were not strobed.
        InvalidRecording: the file is damaged, or holds no scans.
    """
    # The file library and the kernels are loaded by who reads a recording.
    from hardware.recording.reader import RecordingReader
    from service.api.recordings.reprocessing import reprocess
    from service.pipeline.active_calibration import NO_ACTIVE_CALIBRATION
    from service.pipeline.frame_processor import FrameProcessor
    from service.pipeline.taps import clear_readings

    collected = _Exposures()
    with RecordingReader(path) as reader:
        description = reader.info.description
        sensors = tuple(SensorGeometry(one.name, one.pixels) for one in description.sensors)
        _check_strobed(path.name, markers, description.markers)
        processor = FrameProcessor("wand", description, "cpu")
        count = 0
        for batch in reprocess(reader, processor, given=NO_ACTIVE_CALIBRATION):
            for index, frame in enumerate(batch.frames):
                if frame.marker is not None:
                    lines = slice(index * len(sensors), (index + 1) * len(sensors))
                    read = clear_readings(batch, lines, strobed=True)
                    collected.add(frame.exposure_device_ns, frame.marker, *read)
            count += len(batch.frames)
            done(count / max(reader.info.frames, 1))
    return collected.table(path, sensors, markers), sensors


class LiveWand:
    """Collects the readings of a wand from the stream of a running device.

    Args:
        client: of the server.
        device: the device's id.
        markers: strobed markers of the wand, in its order.
    """

    def __init__(self, client: Client, device: str, markers: Sequence[int]) -> None:
        self._client = client
        self._device = device
        self._markers = tuple(markers)
        self._collected = _Exposures()
        described = client.device(device)
        self.sensors = tuple(SensorGeometry(one.name, one.pixels) for one in described.sensors)

    def collect(self, seconds: float, every_s: float) -> Iterator[ReadingTable]:
        """Yield all poses so far, about every ``every_s`` seconds, for ``seconds``.

        Args:
            seconds: how long.
            every_s: time between two results [s].

        Raises:
            InvalidParameter: the device does not strobe the markers.
        """
        columns = {sensor.name: index for index, sensor in enumerate(self.sensors)}
        end = time.monotonic() + seconds
        due = time.monotonic() + every_s
        with self._client.stream(self._device, ("peaks",), bundle_ms=BUNDLE_MS) as stream:
            for message in stream:
                if isinstance(message, Hello) and message.markers is not None:
                    _check_strobed(self._device, self._markers, message.markers)
                if isinstance(message, Frame) and message.marker is not None:
                    read = _brightest(message, columns)
                    self._collected.add(message.device_ns, message.marker, *read)
                now = time.monotonic()
                if now >= due and self._collected:
                    due = now + every_s
                    yield self.table()
                if now >= end:
                    return

    def table(self) -> ReadingTable:
        """Return all poses so far."""
        return self._collected.table(Path(self._device), self.sensors, self._markers)


class _Exposures:
    """Strobed exposures in the order of time."""

    def __init__(self) -> None:
        self._rows: list[tuple[int, int, Array, Array]] = []

    def __len__(self) -> int:
        return len(self._rows)

    def add(self, device_ns: int, marker: int, position_px: Array, sigma_px: Array) -> None:
        self._rows.append((device_ns, marker, position_px, sigma_px))

    def table(
        self, path: Path, sensors: Sequence[SensorGeometry], markers: Sequence[int]
    ) -> ReadingTable:
        if not self._rows:
            raise InvalidParameter(f"{path} has no exposure in which one marker was lit alone")
        begin = self._rows[0][0]
        exposures = StrobedReadings(
            np.array([1e-9 * (row[0] - begin) for row in self._rows]),
            np.array([row[1] for row in self._rows], dtype=np.intp),
            np.array([row[2] for row in self._rows]),
            np.array([row[3] for row in self._rows]),
        )
        pixels = [sensor.pixels for sensor in sensors]
        readings, sigma = strobed_poses(exposures, markers, pixels)
        names = tuple(sensor.name for sensor in sensors)
        return ReadingTable(path, names, readings, sigma)


def _brightest(frame: Frame, columns: "Mapping[str, int]") -> tuple[Array, Array]:
    """Return the readings and sigmas (S,) of the lit marker: each sensor's brightest peak."""
    position, sigma = np.full(len(columns), np.nan), np.full(len(columns), np.nan)
    amplitude = np.full(len(columns), -np.inf)
    for peak in frame.peaks or ():
        column = columns[peak.sensor]
        if peak.amplitude > amplitude[column]:
            clear = not UNCLEAR_FLAGS.intersection(peak.flags)
            amplitude[column] = peak.amplitude
            position[column] = peak.position_px if clear else np.nan
            sigma[column] = peak.sigma_px if clear else np.nan
    return position, sigma


def _check_strobed(source: str, markers: Sequence[int], strobed: int) -> None:
    if strobed == 0:
        raise InvalidParameter(
            f"{source} lights all markers together, so that the wand's ends cannot be told apart; "
            "strobe them (setting strobe of the device)"
        )
    for number in markers:
        if not 0 <= number < strobed:
            raise InvalidParameter(
                f"{source} strobes markers 0 to {strobed - 1}; it has no marker {number}"
            )
