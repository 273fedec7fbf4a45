"""Sources of radiometric calibrations: captures, recordings, scans, documents."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from compute.errors import InvalidParameter
from compute.signal.bad_pixel_monitor import masking_calibration
from compute.signal.radiometric_calibration import RadiometricCalibration
from hardware.driver import SensorDescription
from service.api.devices.driver_factory import recording_path
from service.api.devices.schema import check_sensors
from service.api.devices.store import active_radiometric_id
from service.api.radiometric_calibrations import capture_store
from service.api.radiometric_calibrations.capture_checks import check_flat
from service.api.radiometric_calibrations.content import (
    RadiometricContent,
    estimate_sensors,
    sensor_calibrations,
)
from service.api.radiometric_calibrations.frame_statistics import FrameStatistics, statistics_of
from service.api.radiometric_calibrations.recorded_frames import estimate_from_recordings
from service.api.radiometric_calibrations.recorded_lines import with_line_shapes
from service.api.radiometric_calibrations.schema import (
    FromBadPixels,
    FromCapture,
    FromDocument,
    FromLines,
    FromRecordings,
    FromScans,
    NewRadiometricCalibration,
)
from service.api.radiometric_calibrations.store import active_radiometric, check_content
from service.database.engine import Database
from service.pipeline.active_calibration import bad_pixel_flags
from service.pipeline.interface import Pipeline, RunningDevice

if TYPE_CHECKING:
    from numpy.typing import NDArray


def content_from(
    request: NewRadiometricCalibration,
    sensors: Sequence[SensorDescription],
    database: Database,
    recordings: Path,
    live: Pipeline,
) -> RadiometricContent:
    """Return the calibrations of the sensors that a request asks for.

    Args:
        request: the request.
        sensors: the device's.
        database: holds the sessions of captures.
        recordings: the folder of recordings.
        live: has the running devices.

    Raises:
        LumilineError: what the request names does not exist, or nothing can be estimated from it.
    """
    found: Mapping[str, RadiometricCalibration]
    match request.source:
        case FromCapture() as source:
            found = _from_capture(source, request.device_id, database)
        case FromRecordings() as source:
            dark, *flats = (
                recording_path(name, recordings)
                for name in (source.dark_recording_id, *source.flat_recording_ids)
            )
            recorded, found = estimate_from_recordings(
                dark,
                flats,
                relative_light=source.relative_light,
                temperature_c=source.temperature_c,
            )
            check_sensors(request.device_id, sensors, recorded.sensors)
        case FromScans() as source:
            found = {
                name: _from_scans(name, scans.dark, scans.flats, source)
                for name, scans in source.sensors.items()
            }
        case FromDocument() as source:
            found = sensor_calibrations(source.sensors)
        case FromLines() as source:
            recorded, found = with_line_shapes(
                recording_path(source.recording_id, recordings),
                _active_sensors(request.device_id, database),
            )
            check_sensors(request.device_id, sensors, recorded.sensors)
        case FromBadPixels():
            found = _from_bad_pixels(live.session(request.device_id))
    content = RadiometricContent(request.device_id, found)
    check_content(content, sensors)
    return content


def _from_capture(
    source: FromCapture, device: str, database: Database
) -> dict[str, RadiometricCalibration]:
    with database.read() as session:
        row, captured, found = capture_store.complete_captures(
            session, source.radiometric_capture_id, device
        )
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


def _active_sensors(device: str, database: Database) -> Mapping[str, RadiometricCalibration]:
    with database.read() as session:
        active = active_radiometric_id(session, device)
        return {} if active is None else active_radiometric(session, active).sensors


def _from_bad_pixels(running: RunningDevice) -> dict[str, RadiometricCalibration]:
    """Return the active calibrations of a device, with the bad pixels that its frames have shown.

    Raises:
        InvalidParameter: there are none.
    """
    active, description = running.active_calibration, running.description
    if not active.bad_pixels:
        raise InvalidParameter(
            f'the frames of device "{running.device_id}" have shown no bad pixel since its start; '
            "its status lists them: let lights move over the sensors for a minute"
        )
    found = dict(active.radiometric.sensors) if active.radiometric else {}
    for name in {one.sensor for one in active.bad_pixels}:
        pixels = next(sensor.pixels for sensor in description.sensors if sensor.name == name)
        flags = bad_pixel_flags(active.bad_pixels, name, pixels)
        found[name] = (
            found[name].with_bad_pixels(flags)
            if name in found
            else masking_calibration(
                flags,
                description.electrons_per_count,
                description.read_noise_electrons,
                description.offset_counts,
                2**description.bits - 1,
            )
        )
    return found


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
