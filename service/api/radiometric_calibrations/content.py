"""Content of a radiometric calibration: estimated from statistics, stored and hashed as JSON."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, Final

import numpy as np

from compute.errors import InvalidParameter
from compute.signal.radiometric_calibration import RadiometricCalibration, estimate
from service.api.calibrations.calibration_content import canonical_json, content_hash
from service.api.radiometric_calibrations.frame_statistics import FrameStatistics
from service.api.radiometric_calibrations.schema import SensorFigures

_OPTIONAL: Final = {
    field.name: None for field in fields(RadiometricCalibration) if field.default is None
}


@dataclass(frozen=True, eq=False)
class RadiometricContent:
    """Radiometric calibrations of a device's sensors, immutable, and what is hashed.

    Args:
        device: the device's id.
        sensors: the calibration of each sensor that has one, by name.
    """

    device: str
    sensors: Mapping[str, RadiometricCalibration]

    def document(self) -> dict[str, Any]:
        """Return it as a JSON object."""
        return {
            "device": self.device,
            "sensors": {name: one.to_document() for name, one in self.sensors.items()},
        }

    def content_hash(self) -> str:
        """Return SHA-256 of the document's canonical JSON, in hexadecimal."""
        return content_hash(self.document())

    def figures(self) -> list[SensorFigures]:
        """Return figures of each sensor."""
        return [sensor_figures(name, one) for name, one in self.sensors.items()]


def content_of(document: Mapping[str, Any]) -> RadiometricContent:
    """Return the content of a stored document.

    Raises:
        InvalidParameter: it is none.
    """
    try:
        device, sensors = str(document["device"]), dict(document["sensors"])
    except (KeyError, TypeError, ValueError) as error:
        raise InvalidParameter(
            f"the document is no radiometric calibration of a device ({error!r}); it must have "
            "the members device and sensors"
        ) from error
    return RadiometricContent(device, sensor_calibrations(sensors))


def sensor_calibrations(
    documents: Mapping[str, dict[str, Any]],
) -> dict[str, RadiometricCalibration]:
    """Return the calibrations of documents by sensor; raises InvalidParameter."""
    found = {}
    for name, one in documents.items():
        try:
            canonical_json({"sensor": one})  # no NaN, which no hash could be taken of
            # Many a client leaves out what is null.
            found[name] = RadiometricCalibration.from_document(_OPTIONAL | one)
        except (InvalidParameter, ValueError, TypeError) as error:
            detail = error.detail if isinstance(error, InvalidParameter) else str(error)
            raise InvalidParameter(f"sensor {name}: {detail}", sensor=name) from error
    if not found:
        raise InvalidParameter("there is no sensor; give the calibration of one at least")
    return found


def estimate_sensors(
    sensors: Sequence[str],
    dark: FrameStatistics,
    flats: Sequence[FrameStatistics],
    *,
    full_scale_counts: int,
    relative_light: Sequence[float] | None = None,
    temperature_c: float | None = None,
) -> dict[str, RadiometricCalibration]:
    """Estimate the calibration of each sensor.

    Args:
        sensors: the S sensors' names.
        dark: frames of the covered sensors.
        flats: frames under even light, of each level.
        full_scale_counts: the largest count.
        relative_light: light of each level in any unit; None: not known.
        temperature_c: of the sensors; None: not known.

    Raises:
        InvalidParameter: the frames of a sensor are not enough, or not what they should be.
    """
    found = {}
    for number, name in enumerate(sensors):
        try:
            found[name] = estimate(
                dark.sensors[number],
                [flat.sensors[number] for flat in flats],
                full_scale_counts=full_scale_counts,
                relative_light=relative_light,
                temperature_c=temperature_c,
            )
        except InvalidParameter as error:
            raise InvalidParameter(f"sensor {name}: {error.detail}", sensor=name) from error
    return found


def sensor_figures(name: str, found: RadiometricCalibration) -> SensorFigures:
    """Return the figures of a sensor's calibration."""
    return SensorFigures(
        sensor=name,
        pixels=found.pixels,
        captures=found.captures,
        gain_electrons_per_count=found.gain_electrons_per_count,
        read_noise_counts=found.read_noise_counts,
        dark_offset_counts=found.mean_offset_counts,
        saturation_counts=found.saturation_counts,
        prnu=found.prnu,
        dsnu_counts=found.dsnu_counts,
        linearity_error=found.linearity_error,
        illumination_range=found.illumination_range,
        bad_pixels=int(np.count_nonzero(~found.good)),
        temperature_c=found.temperature_c,
        line_skewness=None
        if found.line_shape is None
        else float(np.max(np.abs(found.line_shape.skewness))),
    )
