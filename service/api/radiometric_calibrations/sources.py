"""What radiometric calibrations are estimated from: captures, recordings, scans, documents."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from compute.signal.capture_statistics import CaptureStatistics
from hardware.driver import DeviceDescription, SensorDescription
from service.api.devices.driver_factory import recording_path
from service.api.devices.store import check_sensors, sensors_match
from service.api.radiometric_calibrations import capture_store
from service.api.radiometric_calibrations.capture_checks import (
    check_dark,
    check_flat,
    check_frame_count,
)
from service.api.radiometric_calibrations.content import (
    RadiometricContent,
    estimate_sensors,
    sensor_calibrations,
)
from service.api.radiometric_calibrations.frame_statistics import (
    FrameAccumulator,
    FrameStatistics,
    statistics_of,
)
from service.api.radiometric_calibrations.schema import (
    FromCapture,
    FromDocument,
    FromRecordings,
    FromScans,
    NewRadiometricCalibration,
)
from service.database.engine import Database

MAX_RECORDED_FRAMES: Final = 4096
"""Frames of a recording that count, from its first on: more make nothing better that matters."""


def content_from(
    request: NewRadiometricCalibration,
    sensors: Sequence[SensorDescription],
    database: Database,
    recordings: Path,
) -> RadiometricContent:
    """Return the calibrations of the sensors that a request asks for.

    Args:
        request: the request.
        sensors: the device's.
        database: holds the sessions of captures.
        recordings: the folder of recordings.

    Raises:
        LumilineError: what the request names does not exist, or nothing can be estimated from it.
    """
    source = request.source
    match source:
        case FromCapture():
            found = _from_capture(source, request.device, database)
        case FromRecordings():
            paths = [recording_path(name, recordings) for name in (source.dark, *source.flats)]
            recorded = RecordedFrames.read(paths[0], paths[1:])
            check_sensors(request.device, sensors, recorded.description.sensors)
            found = recorded.estimate(source.relative_light, source.temperature_c)
        case FromScans():
            found = _from_scans(source)
        case FromDocument():
            found = sensor_calibrations(source.sensors)
    content = RadiometricContent(request.device, found)
    content.check_sensors(sensors)
    return content


def _from_capture(source: FromCapture, device: str, database: Database):
    with database.read() as session:
        row, captured, found = capture_store.complete_captures(session, source.capture, device)
        names = [sensor["name"] for sensor in row.sensors]
    flats = [one for one in captured if one.kind == "flat"]
    light = [one.relative_light for one in flats]
    known = [one for one in light if one is not None]
    temperatures = [one.temperature_c for one in captured if one.temperature_c is not None]
    return estimate_sensors(
        names,
        found[capture_store.DARK],
        [found[one.name] for one in flats],
        full_scale_counts=captured[0].full_scale_counts,
        relative_light=known if len(known) == len(light) else None,
        temperature_c=float(np.mean(temperatures)) if temperatures else None,
    )
