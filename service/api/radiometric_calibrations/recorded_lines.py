"""Line shapes of sensors from a recording of one marker that is moved through the field."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from compute.errors import InvalidParameter
from compute.signal.bad_pixel_monitor import masking_calibration
from compute.signal.fit.line_spread_estimate import estimate_line_spread
from compute.signal.pixel_corrections import PixelCorrections, calibrated_noise
from compute.signal.radiometric_calibration import RadiometricCalibration
from compute.signal.sensor_noise import SensorNoise
from hardware.driver import DeviceDescription
from service.pipeline.detection_stage import FREE_WIDTH_FIT, peak_method

MAX_LINE_FRAMES: Final = 8000
"""Frames of a recording that count, evenly over it."""


def with_line_shapes(
    recording: Path, calibrations: Mapping[str, RadiometricCalibration]
) -> tuple[DeviceDescription, dict[str, RadiometricCalibration]]:
    """Return calibrations of a recorded device's sensors with the shapes of their lines.

    Args:
        recording: of frames with one marker, which is moved so that its line passes over all
            sensors.
        calibrations: of the pixels, by sensor; the data sheet stands for one that is not there.

    Returns:
        The recorded device, and the calibrations by sensor.

    Raises:
        InvalidRecording: the file cannot be read, or holds no lines.
        InvalidParameter: the device's lines are not fitted, a calibration has another number of
            pixels, or a sensor has too few clear lines.
    """
    # The file library is loaded by who reads a recording.
    from hardware.recording.reader import RecordingReader

    with RecordingReader(recording) as reader:
        device, frames = reader.info.description, reader.info.frames
        if peak_method(device) != "fit":
            raise InvalidParameter(
                f"the peaks of {device.name} are not fitted: only fits know a line's shape"
            )
        every = max(frames // MAX_LINE_FRAMES, 1)
        chosen = [one.lines for number, one in enumerate(reader.frames()) if number % every == 0]
    if not chosen:
        raise InvalidParameter(f"{recording.name} holds no frames")
    lines = np.stack(chosen)
    none = np.zeros(lines.shape[2], np.uint8)
    full_scale = 2**device.bits - 1
    found = {}
    for number, sensor in enumerate(device.sensors):
        own = calibrations.get(sensor.name) or masking_calibration(
            none,
            device.electrons_per_count,
            device.read_noise_electrons,
            device.offset_counts,
            full_scale,
        )
        try:
            corrections = PixelCorrections.of([own], sensor.pixels)
            noise = calibrated_noise([own], SensorNoise.of(1.0, 0.0))
            scans = np.ascontiguousarray(lines[:, number])
            shape = estimate_line_spread(scans, FREE_WIDTH_FIT, noise, corrections)
        except InvalidParameter as error:
            raise InvalidParameter(
                f"sensor {sensor.name}: {error.detail}", sensor=sensor.name
            ) from error
        found[sensor.name] = replace(own, line_shape=shape)
    return device, found
