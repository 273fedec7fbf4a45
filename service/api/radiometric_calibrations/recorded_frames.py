"""Radiometric calibration from recordings: one of covered sensors, one for each level of light."""

from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Final

from compute.errors import InvalidParameter
from compute.signal.radiometric_calibration import MIN_CAPTURES, RadiometricCalibration
from hardware.driver import DeviceDescription
from service.api.devices.schema import listed, sensors_match
from service.api.radiometric_calibrations.capture_checks import (
    check_dark,
    check_flat,
    check_frame_count,
)
from service.api.radiometric_calibrations.content import estimate_sensors
from service.api.radiometric_calibrations.frame_statistics import FrameStatistics, statistics_of

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

MAX_RECORDED_FRAMES: Final = 4096
"""Frames of a recording that count, from its first on: more make nothing better that matters."""


def estimate_from_recordings(
    dark: Path,
    flats: Sequence[Path],
    *,
    relative_light: Sequence[float] | None = None,
    temperature_c: float | None = None,
) -> tuple[DeviceDescription, dict[str, RadiometricCalibration]]:
    """Estimate the calibration of each sensor from recordings.

    Args:
        dark: recorded with covered sensors.
        flats: recorded under even light, each with another amount of it.
        relative_light: light of each level in any unit; None: not known.
        temperature_c: of the sensors; None: not known.

    Returns:
        The recorded device, and the calibrations by sensor.

    Raises:
        InvalidRecording: a file cannot be read, or holds no lines.
        InvalidParameter: the recordings are of other sensors, or nothing can be estimated.
        UnusableRadiometricCapture: there is light in the dark frames, or the flat ones are
            saturated, too dark, uneven or flicker.
    """
    device, covered = _read(dark)
    names = [sensor.name for sensor in device.sensors]
    full_scale = 2**device.bits - 1
    check_dark(covered, names, device.offset_counts, full_scale)
    lit = []
    for path in flats:
        other, found = _read(path)
        if not sensors_match(other.sensors, device.sensors) or other.bits != device.bits:
            raise InvalidParameter(
                f"{path.name} is of {listed(other.sensors)} with {other.bits} bits, {dark.name} of "
                f"{listed(device.sensors)} with {device.bits}; both must be of one device"
            )
        check_flat(found, names, covered, full_scale)
        lit.append(found)
    return device, estimate_sensors(
        names,
        covered,
        lit,
        full_scale_counts=full_scale,
        relative_light=relative_light,
        temperature_c=temperature_c,
    )


def _read(path: Path) -> tuple[DeviceDescription, FrameStatistics]:
    # The file library is loaded by who reads a recording.
    from hardware.recording.reader import RecordingReader

    with RecordingReader(path) as reader:
        device, frames = reader.info.description, reader.info.frames
        check_frame_count(frames, MIN_CAPTURES, path.name)
        lines: Iterator[NDArray[np.uint16]] = (frame.lines for frame in reader.frames())
        return device, statistics_of(islice(lines, MAX_RECORDED_FRAMES), len(device.sensors))
