"""What radiometric calibrations are estimated from: captures, recordings, scans, documents."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from compute.errors import InvalidParameter
from compute.signal.radiometric_calibration import RadiometricCalibration
from hardware.driver import SensorDescription
from service.api.devices.driver_factory import recording_path
from service.api.devices.schema import check_sensors
from service.api.radiometric_calibrations import capture_store
from service.api.radiometric_calibrations.capture_checks import check_flat
from service.api.radiometric_calibrations.content import (
    RadiometricContent,
    estimate_sensors,
    sensor_calibrations,
)
from service.api.radiometric_calibrations.frame_statistics import FrameStatistics, statistics_of
from service.api.radiometric_calibrations.recorded_frames import estimate_from_recordings
from service.api.radiometric_calibrations.schema import (
    FromCapture,
    FromDocument,
    FromRecordings,
    FromScans,
    NewRadiometricCalibration,
)
from service.api.radiometric_calibrations.store import check_content
from service.database.engine import Database

if TYPE_CHECKING:
    from numpy.typing import NDArray


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
    found: Mapping[str, RadiometricCalibration]
    match request.source:
        case FromCapture() as source:
            found = _from_capture(source, request.device, database)
        case FromRecordings() as source:
            dark, *flats = (
                recording_path(name, recordings) for name in (source.dark, *source.flats)
            )
            recorded, found = estimate_from_recordings(
                dark,
                flats,
                relative_light=source.relative_light,
                temperature_c=source.temperature_c,
            )
            check_sensors(request.device, sensors, recorded.sensors)
        case FromScans() as source:
            found = {
                name: _from_scans(name, scans.dark, scans.flats, source)
                for name, scans in source.sensors.items()
            }
        case FromDocument() as source:
            found = sensor_calibrations(source.sensors)
    content = RadiometricContent(request.device, found)
    check_content(content, sensors)
    return content


def _from_capture(
    source: FromCapture, device: str, database: Database
) -> dict[str, RadiometricCalibration]:
    with database.read() as session:
        row, captured, found = capture_store.complete_captures(session, source.capture, device)
        names = [sensor["name"] for sensor in row.sensors]
    flats = [one for one in captured if one.kind == "flat"]
    light = [one.relative_light for one in flats if one.relative_light is not None]
    temperatures = [one.temperature_c for one in captured if one.temperature_c is not None]
    return estimate_sensors(
        names,
        found[capture_store.DARK],
        [found[one.name] for one in flats],
        full_scale_counts=captured[0].full_scale_counts,
        relative_light=light if len(light) == len(flats) else None,
        temperature_c=float(np.mean(temperatures)) if temperatures else None,
    )


def _from_scans(
    name: str, dark: list[list[int]], flats: list[list[list[int]]], source: FromScans
) -> RadiometricCalibration:
    covered = _statistics(name, dark)
    lit = [_statistics(name, one) for one in flats]
    for one in lit:
        check_flat(one, [name], covered, source.full_scale_counts)
    return estimate_sensors(
        [name],
        covered,
        lit,
        full_scale_counts=source.full_scale_counts,
        relative_light=source.relative_light,
        temperature_c=source.temperature_c,
    )[name]


def _statistics(name: str, scans: list[list[int]]) -> FrameStatistics:
    lengths = sorted({len(scan) for scan in scans})
    if len(lengths) > 1:
        raise InvalidParameter(
            f"sensor {name}: scans have {lengths[0]} to {lengths[-1]} values; all must be of one "
            "length",
            sensor=name,
        )
    frames: NDArray[np.uint16] = np.array(scans, dtype=np.uint16)
    return statistics_of(frames[:, None], 1)
