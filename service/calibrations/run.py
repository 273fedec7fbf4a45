"""One calibration run: from a request's control points to the content that is stored."""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter

from compute.calibration.crossvalidation import fitted_errors, leave_one_out
from compute.calibration.result import AxisErrors, Calibration
from compute.calibration.run import calibrate
from compute.calibration.settings import CalibrationSettings
from hardware.driver import SensorDescription
from service.calibrations.observations import geometry, observations
from service.calibrations.schema import (
    LEAVE_ONE_OUT_POINTS,
    ControlPoint,
    ControlPointErrors,
    NewCalibration,
    PointErrors,
    Provenance,
)

_RESULT = TypeAdapter(Calibration)
_POINTS = TypeAdapter(list[ControlPoint])


@dataclass(frozen=True)
class Outcome:
    """What a run yields.

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


def run_calibration(request: NewCalibration, sensors: Sequence[SensorDescription]) -> Outcome:
    """Calibrate, and reconstruct the control points with the result and without each point.

    Raises:
        LumilineError: what was wrong with the points; see compute.calibration.run.calibrate.
    """
    observed = observations(request.points, sensors)
    sigma = observed.all_or_no_sigma()
    points = np.array([point.position_mm for point in request.points], dtype=np.float64)
    points = points.reshape(-1, 3)
    geometries = geometry(sensors)
    settings = CalibrationSettings(request.method)
    result = calibrate(points, observed.readings_px, geometries, sigma, settings)
    fitted = fitted_errors(result, points, observed.readings_px, sigma)
    left_out = None
    if len(points) <= LEAVE_ONE_OUT_POINTS:
        left_out = leave_one_out(points, observed.readings_px, geometries, sigma, settings)
    errors = ControlPointErrors(
        fitted=_point_errors(fitted),
        leave_one_out=None if left_out is None else _point_errors(left_out),
    )
    content = calibration_content(request.device, "fitted", request.points, result)
    return Outcome(result, content, errors.model_dump(mode="json"))


def _point_errors(differences_mm: NDArray[np.float64]) -> PointErrors:
    statistics = AxisErrors.of(differences_mm)
    return PointErrors(
        statistics=statistics if statistics.points else None,
        differences_mm=[
            (row[0], row[1], row[2]) if np.isfinite(row).all() else None
            for row in differences_mm.tolist()
        ],
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


def content_hash(content: dict[str, Any]) -> str:
    """Return the SHA-256 of the canonical JSON: sorted keys, no spaces, UTF-8."""
    text = json.dumps(
        content, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False
    )
    return hashlib.sha256(text.encode()).hexdigest()
