"""Readings of a recording by strobe cycle: still periods, and the means at known targets."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from hardware.driver import SensorDescription
from service.api.captures.averaging import AveragedReading, average, to_captured
from service.api.captures.schema import CapturedTarget, CaptureSettings, Target
from service.api.devices.schema import check_sensors
from service.problems.errors import NoObservation, TargetMoved

if TYPE_CHECKING:
    from hardware.recording.reader import RecordingReader
    from service.pipeline.detection_stage import FindProfile

Array = NDArray[np.float64]

MIN_STILL_CYCLES: Final = 10
"""Fewest strobe cycles of a still period."""


@dataclass(frozen=True, eq=False)
class StrobeCycles:
    """Readings of a recording by strobe cycle; a cycle is one exposure where nothing is strobed.

    Args:
        sensors: the S sensors.
        readings_px: of the M strobed markers, or of the only one, shape (C, M, S) [px]; NaN where
            not seen.
        sigma_px: likewise [px].
        strobed: whether the markers are strobed.
    """

    sensors: tuple[SensorDescription, ...]
    readings_px: Array
    sigma_px: Array
    strobed: bool

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the sensors."""
        return tuple(sensor.name for sensor in self.sensors)


def recorded_readings(
    reader: "RecordingReader",
    report: Callable[[float], None],
    find_profile: "FindProfile | None" = None,
) -> Iterator[tuple[int, int | None, Array, Array]]:
    """Yield of each exposure its device time [ns], lit marker, readings and sigmas (S,) [px].

    Args:
        reader: of the recording.
        report: called with the share of the frames processed.
        find_profile: returns the device profile that the recording names; None: a built-in one.

    Raises:
        InvalidRecording: the file is damaged, or holds no scans.
    """
    # The kernels are loaded by who reads a recording.
    from service.api.recordings.reprocessing import reprocess
    from service.pipeline.active_calibration import NO_ACTIVE_CALIBRATION
    from service.pipeline.detection_stage import built_in_profile, expected_scans
    from service.pipeline.frame_processor import FrameProcessor
    from service.pipeline.taps import clear_readings

    description = reader.info.description
    sensors = len(description.sensors)
    model = expected_scans(description, find_profile or built_in_profile)
    processor = FrameProcessor("readings", description, "cpu", model)
    count = 0
    for batch in reprocess(reader, processor, given=NO_ACTIVE_CALIBRATION):
        for index, frame in enumerate(batch.frames):
            lines = slice(index * sensors, (index + 1) * sensors)
            read = clear_readings(batch, lines, strobed=frame.marker is not None)
            yield frame.exposure_device_ns, frame.marker, *read
        count += len(batch.frames)
        report(count / max(reader.info.frames, 1))


def read_cycles(
    path: Path, report: Callable[[float], None], find_profile: "FindProfile | None" = None
) -> StrobeCycles:
    """Return the readings of a recording by strobe cycle; the arguments as of recorded_readings.

    Raises:
        InvalidRecording: the file is damaged, or holds no scans.
    """
    from hardware.recording.reader import RecordingReader

    with RecordingReader(path) as reader:
        description = reader.info.description
        shape = (2, max(1, description.markers), len(description.sensors))
        cycles: list[Array] = []
        filled: set[int] = set()
        for _, lit, position, sigma in recorded_readings(reader, report, find_profile):
            if description.markers and lit is None:
                continue  # all are lit: nothing says which peak is whose
            marker = lit or 0
            if not cycles or marker in filled:
                cycles.append(np.full(shape, np.nan))
                filled = set()
            cycles[-1][:, marker] = position, sigma
            filled.add(marker)
    both = np.array(cycles).reshape(-1, *shape)
    return StrobeCycles(description.sensors, both[:, 0], both[:, 1], description.markers > 0)


def still_periods(readings_px: Array, limit_px: float) -> list[slice]:
    """Return the periods in which all readings stay within a limit.

    Args:
        readings_px: shape (C, ...) [px]; NaN where not seen.
        limit_px: largest difference of two readings of a period [px].
    """
    flat = readings_px.reshape(len(readings_px), -1)
    periods = []
    start = 0
    low = high = np.full(flat.shape[1], np.nan)
    for index, row in enumerate(flat):
        low, high = np.fmin(low, row), np.fmax(high, row)
        if (high - low > limit_px).any():
            periods.append(slice(start, index))
            start, low, high = index, row, row
    periods.append(slice(start, len(flat)))
    return [one for one in periods if one.stop - one.start >= MIN_STILL_CYCLES]


def average_period(
    cycles: StrobeCycles, period: slice, marker: int, name: str, seen_share: float
) -> AveragedReading:
    """Average a marker's readings over a period; raises what ``average`` does.

    Args:
        cycles: readings of the recording.
        period: its cycles.
        marker: number of the marker, from 0.
        name: the marker's or target's name, for messages.
        seen_share: share of the period in which a sensor must have seen the marker.
    """
    return average(
        cycles.readings_px[period, marker], cycles.sigma_px[period, marker], cycles.names,
        seen_share, name,
    )  # fmt: skip


def rests(cycles: StrobeCycles, limit_px: float, seen_share: float) -> list[slice]:
    """Return the still periods without those in which a marker creeps.

    Args:
        cycles: readings of the recording.
        limit_px: largest difference of two readings of a period [px].
        seen_share: share of a period in which a sensor must have seen a marker.
    """
    return [
        one
        for one in still_periods(cycles.readings_px, limit_px)
        if _at_rest(cycles, one, seen_share)
    ]


def _at_rest(cycles: StrobeCycles, period: slice, seen_share: float) -> bool:
    columns = 0
    for marker in range(cycles.readings_px.shape[1]):
        try:
            average_period(cycles, period, marker, "", seen_share)
        except TargetMoved:
            return False
        except NoObservation:
            continue
        columns += 1
    return columns > 0


def target_readings(
    cycles: StrobeCycles, targets: Sequence[Target], limit_px: float, seen_share: float
) -> list[AveragedReading]:
    """Return the mean readings of each target.

    Args:
        cycles: readings of the recording.
        targets: each with its strobed marker, or all without, in the order of the visits.
        limit_px: largest difference of two readings of a still period [px].
        seen_share: share of a period in which a sensor must have seen the marker.

    Raises:
        InvalidParameter: the targets do not fit the markers or the still periods.
        NoObservation: fewer than three sensors saw a target.
        TargetMoved: a target's readings spread or drift.
    """
    strobed = [one for one in targets if one.marker is not None]
    markers = cycles.readings_px.shape[1] if cycles.strobed else 0
    periods: Sequence[slice] = [slice(0, len(cycles.readings_px))] * len(targets)
    if strobed:
        for one in targets:
            if one.marker is None or one.marker >= markers:
                said = "none" if one.marker is None else str(one.marker)
                raise InvalidParameter(
                    f'target "{one.name}" has the marker {said}; the recording strobes '
                    f"{f'the markers 0 to {markers - 1}' if markers else 'no markers'}: give each "
                    "target one of them, or none to any"
                )
    elif markers > 1:
        raise InvalidParameter(
            f"the recording strobes the markers 0 to {markers - 1}; give each target its `marker`"
        )
    else:
        periods = rests(cycles, limit_px, seen_share)
        if len(periods) != len(targets):
            raise InvalidParameter(
                f"the recording has {len(periods)} still periods of {MIN_STILL_CYCLES} exposures "
                f"and more within {limit_px:g} px, and there are {len(targets)} targets; list the "
                "targets in the order of the visits, or change still_px"
            )
    return [
        average_period(cycles, period, one.marker or 0, one.name, seen_share)
        for one, period in zip(targets, periods, strict=True)
    ]


def captured_targets(
    path: Path, device_id: str, sensors: Sequence[SensorDescription], targets: Sequence[Target],
    settings: CaptureSettings, find_profile: "FindProfile | None" = None,
) -> list[CapturedTarget]:  # fmt: skip
    """Return what a recording has of a capture session's targets.

    Args:
        path: the recording.
        device_id: the session's device.
        sensors: its sensors.
        targets: of the session.
        settings: of the session.
        find_profile: returns the device profile that the recording names; None: a built-in one.

    Raises:
        InvalidRecording: the file is damaged, or holds no scans.
        SensorsChanged: it is of other sensors than the device's.
        LumilineError: what ``target_readings`` raises.
    """
    cycles = read_cycles(path, lambda _share: None, find_profile)
    check_sensors(device_id, sensors, cycles.sensors)
    marked = [
        one if one.marker is not None else one.model_copy(update={"marker": settings.marker})
        for one in targets
    ]
    now = datetime.now(UTC)
    found = target_readings(cycles, marked, settings.still_px, settings.seen_share)
    return [
        to_captured(one.name, mean, cycles.names, now)
        for one, mean in zip(targets, found, strict=True)
    ]
