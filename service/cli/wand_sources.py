"""Readings of a waved wand with strobed markers, from a recording or a running device."""

import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from compute.calibration.self_calibration.strobed_poses import (
    StrobedPoseCollector,
    StrobedReadings,
)
from compute.camera.model import SensorGeometry
from compute.errors import InvalidParameter
from compute.flags import flag_names
from compute.measurement.flag_policy import STANDARD_POLICY
from lumiline.client import Client
from lumiline.client.messages import Frame, Hello
from service.cli.observations_csv import ReadingTable

if TYPE_CHECKING:
    from collections.abc import Mapping

Array = NDArray[np.float64]

UNCLEAR_FLAGS: Final = frozenset(flag_names(STANDARD_POLICY.unclear_flags))
BUNDLE_MS: Final = 50.0


def read_recorded_wand(
    path: Path, markers: Sequence[int], report: Callable[[float], None]
) -> tuple[ReadingTable, tuple[SensorGeometry, ...]]:
    """Return the poses of a wand in a recording of line scans, and the device's sensors.

    Args:
        path: HDF5 file.
        markers: strobed markers of the wand, in its order.
        report: called with the share of the frames processed.

    Raises:
        InvalidParameter: the markers were not strobed.
        InvalidRecording: the file is damaged, or holds no scans.
    """
    # The file library and the kernels are loaded by who reads a recording.
    from hardware.recording.reader import RecordingReader
    from service.api.recordings.recorded_readings import recorded_readings

    with RecordingReader(path) as reader:
        description = reader.info.description
        sensors = tuple(SensorGeometry(one.name, one.pixels) for one in description.sensors)
        _check_strobed(path.name, markers, description.markers)
        collected = _Exposures(str(path), sensors, markers)
        for device_ns, marker, *read in recorded_readings(reader, report):
            if marker is not None:
                collected.add(device_ns, marker, *read)
    return collected.table(), sensors


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
        described = client.device(device)
        self.sensors = tuple(SensorGeometry(one.name, one.pixels) for one in described.sensors)
        self._collected = _Exposures(device, self.sensors, self._markers)

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
                if now >= due and self._collected.complete:
                    due = now + every_s
                    yield self.table()
                if now >= end:
                    return

    def table(self) -> ReadingTable:
        """Return all poses so far."""
        return self._collected.table()


class _Exposures:
    """Strobed exposures in the order of time, turned into poses of a wand as they come."""

    def __init__(self, source: str, sensors: Sequence[SensorGeometry], markers: Sequence[int]):
        self._source = source
        self._sensors = sensors
        self._rows: list[tuple[int, int, Array, Array]] = []
        self._begin_ns: int | None = None
        self._collector = StrobedPoseCollector(markers, [sensor.pixels for sensor in sensors])

    def add(self, device_ns: int, marker: int, position_px: Array, sigma_px: Array) -> None:
        self._rows.append((device_ns, marker, position_px, sigma_px))

    @property
    def complete(self) -> bool:
        """Whether each of the wand's markers was lit."""
        self._collect()
        return self._collector.all_lit

    def table(self) -> ReadingTable:
        """Return all poses so far."""
        self._collect()
        if self._begin_ns is not None:
            self._collector.check_lit()
        readings, sigma = self._collector.poses()
        names = tuple(sensor.name for sensor in self._sensors)
        return ReadingTable(Path(self._source), names, readings, sigma)

    def _collect(self) -> None:
        if not self._rows:
            return
        if self._begin_ns is None:
            self._begin_ns = self._rows[0][0]
        times, markers, readings, sigma = zip(*self._rows, strict=True)
        self._rows = []
        self._collector.add(
            StrobedReadings(
                1e-9 * (np.array(times) - self._begin_ns),
                np.array(markers, dtype=np.intp),
                np.array(readings),
                np.array(sigma),
            )
        )


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
