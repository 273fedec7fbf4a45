"""Content of a calibration: from control points in a request to what is stored and hashed."""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter

from compute.calibration.assessment.assess import (
    MAX_LEAVE_ONE_OUT_POINTS,
    calibrate_and_assess,
    control_errors,
)
from compute.calibration.result import AxisErrors, Calibration, count_readings, effective_readings
from compute.calibration.settings import DEFAULTS as PLAIN
from compute.calibration.settings import CalibrationSettings
from compute.camera.model import SensorGeometry
from compute.errors import DuplicatePoint, InvalidParameter, ReadingOutsideSensor, UnknownSensor
from compute.progress import Progress, no_progress
from hardware.driver import SensorDescription
from service.api.calibrations.schema import (
    ControlPoint,
    ControlPointErrors,
    NewCalibration,
    PointErrors,
    Provenance,
    Reading,
)

_RESULT = TypeAdapter(Calibration)
_POINTS = TypeAdapter(list[ControlPoint])


@dataclass(frozen=True)
class CalibrationRecord:
    """A finished calibration, with the JSON that is stored of it.

    Args:
        result: the calibration.
        content: the JSON object that is stored and hashed.
        errors: the control-point errors as a JSON object.
    """

    result: Calibration
    content: dict[str, Any]
    errors: dict[str, Any]

    @property
    def content_hash(self) -> str:
        """SHA-256 of the content's canonical JSON, in hexadecimal."""
        return content_hash(self.content)


def run_calibration(
    request: NewCalibration, sensors: Sequence[SensorDescription]
) -> CalibrationRecord:
    """Calibrate within a request.

    Raises:
        InvalidParameter: what is asked for takes longer than a request should.
        LumilineError: the points cannot calibrate; see ``calibrate_and_assess``.
    """
    settings = request.settings()
    if len(request.points) > MAX_LEAVE_ONE_OUT_POINTS and settings != PLAIN:
        raise InvalidParameter(
            f"{len(request.points)} points take longer than a request may: POST them to "
            f"/api/v1/runs/calibration, or give at most {MAX_LEAVE_ONE_OUT_POINTS} points, or "
            f"distortion none and labels off, with exact points and the linear loss",
            points=len(request.points),
        )
    return calibration_record(no_progress, request.device_id, request.points, sensors, settings)


def calibration_record(
    progress: Progress,
    device_id: str,
    given: list[ControlPoint],
    sensors: Sequence[SensorDescription],
    settings: CalibrationSettings,
) -> CalibrationRecord:
    """Calibrate, and reconstruct the control points with the result and without each point.

    Args:
        progress: called with the share done and the stage.
        device_id: the device.
        given: the control points.
        sensors: the device's sensors.
        settings: what is asked for.

    Raises:
        LumilineError: the points cannot calibrate; see ``calibrate_and_assess``.
    """
    points, observed, sigma = control_arrays(given, sensors)
    result = calibrate_and_assess(points, observed, geometry(sensors), sigma, settings, progress)
    used, _ = effective_readings(result, observed)
    left_out = {
        check.scheme: point_errors(
            differences := optional_rows(check.differences_mm), count_readings(used, differences)
        )
        for check in result.cross_validation
    }
    errors = ControlPointErrors(
        fitted=point_errors(*control_errors(result, points, observed, sigma)),
        leave_one_out=left_out.get("points"),
        blocks_left_out=left_out.get("blocks"),
    )
    content = calibration_content(device_id, "fitted", given, result)
    return CalibrationRecord(result, content, errors.model_dump(mode="json"))


def control_arrays(
    given: Sequence[ControlPoint], sensors: Sequence[SensorDescription]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64] | None]:
    """Return positions (N, 3) [mm], readings (N, S) [px] and their sigma [px] or None.

    Raises:
        DuplicatePoint, UnknownSensor, ReadingOutsideSensor, InvalidParameter.
    """
    observed = observations(given, sensors)
    sigma = observed.all_or_no_sigma()
    points = np.array([point.position_mm for point in given], dtype=np.float64).reshape(-1, 3)
    return points, observed.readings_px, sigma


def optional_rows(rows: Sequence[tuple[float, float, float] | None]) -> NDArray[np.float64]:
    """Return rows as an array (N, 3); NaN for those that there are not."""
    return np.array([(np.nan,) * 3 if row is None else row for row in rows]).reshape(-1, 3)


def point_errors(differences_mm: NDArray[np.float64], readings: int) -> PointErrors:
    """Return differences (N, 3) [mm] with their figures; NaN where there is no position.

    Args:
        differences_mm: reconstructed minus given points, shape (N, 3) [mm].
        readings: how many readings they rest on.
    """
    statistics = AxisErrors.of(differences_mm)
    return PointErrors(
        statistics=statistics if statistics.points else None,
        differences_mm=[
            (row[0], row[1], row[2]) if np.isfinite(row).all() else None
            for row in differences_mm.tolist()
        ],
        readings=readings,
    )


def calibration_content(
    device_id: str, provenance: Provenance, points: list[ControlPoint], result: Calibration
) -> dict[str, Any]:
    """Return the immutable content of a calibration as a JSON object."""
    return {
        "device": device_id,
        "provenance": provenance,
        "points": _POINTS.dump_python(points, mode="json"),
        "result": _RESULT.dump_python(result, mode="json"),
    }


def result_of(content: dict[str, Any]) -> Calibration:
    """Return the calibration that a stored content holds."""
    return _RESULT.validate_python(content["result"])


def canonical_json(content: dict[str, Any]) -> bytes:
    """Return the canonical JSON: sorted keys, no spaces, UTF-8."""
    return json.dumps(
        content, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False
    ).encode()


def content_hash(content: dict[str, Any]) -> str:
    """Return the SHA-256 of the canonical JSON."""
    return hashlib.sha256(canonical_json(content)).hexdigest()


class ObservedPoint(Protocol):
    """A named point with readings by sensor."""

    @property
    def name(self) -> str:
        """The point's name."""

    @property
    def readings(self) -> dict[str, float | Reading]:
        """Readings by the sensors' names."""


@dataclass(frozen=True, eq=False)
class Observations:
    """Readings and standard deviations, shape (N, S) [px]; NaN where not given."""

    readings_px: NDArray[np.float64]
    sigma_px: NDArray[np.float64]

    def all_or_no_sigma(self) -> NDArray[np.float64] | None:
        """Return sigma, shape (N, S) [px]; None when none is given.

        Raises:
            InvalidParameter: some readings have one and some have not.
        """
        seen = np.isfinite(self.readings_px)
        given = np.isfinite(self.sigma_px)
        if not given.any():
            return None
        if (seen & ~given).any():
            raise InvalidParameter(
                f"{int(given.sum())} of {int(seen.sum())} readings have a standard deviation; "
                "a calibration needs it for all readings, or for none"
            )
        return self.sigma_px


def observations(
    points: Sequence[ObservedPoint], sensors: Sequence[SensorDescription]
) -> Observations:
    """Sort readings by sensor.

    Raises:
        DuplicatePoint: two points have one name.
        UnknownSensor: a reading's sensor is not one of the device's.
        ReadingOutsideSensor: a reading lies outside its sensor's pixels.
    """
    columns = {sensor.name: index for index, sensor in enumerate(sensors)}
    readings = np.full((len(points), len(sensors)), np.nan)
    sigma = np.full_like(readings, np.nan)
    names: dict[str, int] = {}
    for row, point in enumerate(points):
        if point.name in names:
            raise DuplicatePoint(
                f'points {names[point.name] + 1} and {row + 1} are both called "{point.name}"; '
                "give each point once, under its own name",
                point=point.name,
            )
        names[point.name] = row
        for name, reading in point.readings.items():
            if name not in columns:
                raise UnknownSensor(
                    f'point "{point.name}" has a reading of sensor "{name}", which the device '
                    f"does not have; its sensors are {', '.join(columns)}",
                    point=point.name,
                    sensor=name,
                )
            value = reading.position_px if isinstance(reading, Reading) else reading
            _check_inside(value, sensors[columns[name]], point.name)
            readings[row, columns[name]] = value
            if isinstance(reading, Reading):
                sigma[row, columns[name]] = reading.sigma_px
    return Observations(readings, sigma)


def _check_inside(value_px: float, sensor: SensorDescription, point: str) -> None:
    if not -0.5 <= value_px <= sensor.pixels - 0.5:
        raise ReadingOutsideSensor(
            f'the reading {value_px:g} px of point "{point}" lies outside sensor '
            f'"{sensor.name}", whose {sensor.pixels} pixels reach from -0.5 to '
            f"{sensor.pixels - 0.5:g} px",
            point=point,
            sensor=sensor.name,
            reading_px=value_px,
        )


def geometry(sensors: Sequence[SensorDescription]) -> list[SensorGeometry]:
    """Return what the computation needs to know of the sensors."""
    return [SensorGeometry(sensor.name, sensor.pixels, sensor.pitch_um) for sensor in sensors]
