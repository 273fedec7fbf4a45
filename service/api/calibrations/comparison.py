"""Comparison of two calibrations of a device: parameters, positions, control-point errors."""

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from compute.calibration.assessment.assess import fitted_errors
from compute.calibration.assessment.diagnosis import box_points
from compute.calibration.result import Calibration, effective_readings
from compute.camera.model import PARAMETER_COUNT, PARAMETERS, SensorModel, Vector3, vector3
from compute.camera.stack import CameraStack
from compute.reconstruction.triangulation import reconstruct

Array = NDArray[np.float64]

_SIDE: Final = 7
_EXACT_PX: Final = 1e-4
_DECISIVE: Final = 2.0
"""Standard errors by which a mean difference is taken as one."""


@dataclass(frozen=True, eq=False)
class CalibrationWithControlPoints:
    """A calibration and the control points that it is judged on.

    Args:
        calibration: the calibration.
        points_mm: shape (N, 3) [mm]; N may be 0.
        readings_px: as they were given, shape (N, S) [px], NaN where not seen.
        left_out_mm: errors of the points by calibrations that never saw them, shape (N, 3) [mm],
            NaN where there is none; None: not known.
    """

    calibration: Calibration
    points_mm: Array
    readings_px: Array
    left_out_mm: Array | None


@dataclass(frozen=True)
class ParameterDifference:
    """One parameter of one sensor.

    Args:
        sensor: the sensor's name.
        parameter: the parameter's name, which says its unit.
        one: its value in the first calibration; None for rotations, whose difference is a small
            rotation in the sensor's frame.
        other: its value in the second.
        difference: second less first.
        sigmas: over the root of both variances together; None where neither has any. Calibrations
            from the same readings differ by less than that.
    """

    sensor: str
    parameter: str
    one: float | None
    other: float | None
    difference: float
    sigmas: float | None


@dataclass(frozen=True)
class PositionDifferences:
    """Differences of positions by two calibrations from the same readings.

    Args:
        points: positions on a grid over the control points' box.
        low_mm: the box's corner with the least coordinates.
        high_mm: the opposite corner.
        mean_mm: mean difference by axis, second less first.
        rms_mm: root mean square of the distance.
        max_mm: the largest distance.
        aligned_rms_mm: RMS after the best rigid motion of one to the other: what is left when
            the two only differ in where the frame is.
        rms_sigma: RMS of the difference over its standard deviation by both covariances.
    """

    points: int
    low_mm: Vector3
    high_mm: Vector3
    mean_mm: Vector3
    rms_mm: float
    max_mm: float
    aligned_rms_mm: float
    rms_sigma: float | None


@dataclass(frozen=True)
class SameObservations:
    """Both calibrations on the control points of one of them.

    Args:
        of: whose points these are.
        points: that both could reconstruct.
        one_rms_mm: root mean square distance from the given points, by the first.
        other_rms_mm: the same by the second.
        left_out: whether the owner's errors are those of points left out of it; else its errors
            are of points that it was fitted to, which flatters it.
        better: which is nearer by more than two standard errors of the mean difference of squares.
    """

    of: Literal["one", "other"]
    points: int
    one_rms_mm: float
    other_rms_mm: float
    left_out: bool
    better: Literal["one", "other", "neither"]


@dataclass(frozen=True)
class Comparison:
    """Two calibrations beside one another.

    ``positions`` is None where neither has control points, or fewer than three sensors see them.
    """

    parameters: tuple[ParameterDifference, ...]
    positions: PositionDifferences | None
    observations: tuple[SameObservations, ...]


def compare(one: CalibrationWithControlPoints, other: CalibrationWithControlPoints) -> Comparison:
    """Return the differences of two calibrations of the same sensors."""
    given = [held.points_mm for held in (one, other) if len(held.points_mm)]
    positions = None
    if given:
        both = np.concatenate(given)
        positions = _positions(
            one.calibration, other.calibration, both.min(axis=0), both.max(axis=0)
        )
    owners: list[tuple[Literal["one", "other"], CalibrationWithControlPoints]] = [
        ("one", one),
        ("other", other),
    ]
    observations = [
        _same_observations(name, one, other) for name, held in owners if len(held.points_mm)
    ]
    return Comparison(
        tuple(_parameters(one.calibration, other.calibration)),
        positions,
        tuple(found for found in observations if found is not None),
    )


def _parameters(one: Calibration, other: Calibration) -> list[ParameterDifference]:
    found = []
    variances = [_variances(calibration) for calibration in (one, other)]
    for sensor, (first, second) in enumerate(zip(one.models, other.models, strict=True)):
        for name, (value, to, difference) in _model_differences(first, second).items():
            variance = sum(known[sensor].get(name, 0.0) for known in variances)
            sigmas = float(abs(difference) / np.sqrt(variance)) if variance > 0.0 else None
            found.append(ParameterDifference(first.name, name, value, to, difference, sigmas))
    return found


def _variances(calibration: Calibration) -> list[dict[str, float]]:
    """Return the variances of each sensor's parameters by name."""
    diagonal = np.diag(np.array(calibration.covariance)).tolist()
    found, first = [], 0
    for model in calibration.models:
        names = model.parameter_names
        found.append(dict(zip(names, diagonal[first : first + len(names)], strict=True)))
        first += len(names)
    return found


def _model_differences(
    one: SensorModel, other: SensorModel
) -> dict[str, tuple[float | None, float | None, float]]:
    rotation = Rotation.from_matrix(other.rotation @ one.rotation.T).as_rotvec().tolist()
    found: dict[str, tuple[float | None, float | None, float]] = {}
    for name in PARAMETERS[:PARAMETER_COUNT]:
        if name.startswith("rotation_"):
            found[name] = None, None, rotation["xyz".index(name[9])]
        else:
            first, second = float(getattr(one, name)), float(getattr(other, name))
            found[name] = first, second, second - first
    terms = [_distortion(model) for model in (one, other)]
    for name in dict.fromkeys((*terms[0], *terms[1])):
        first, second = (known.get(name, 0.0) for known in terms)
        found[name] = first, second, second - first
    return found


def _distortion(model: SensorModel) -> dict[str, float]:
    if model.distortion is None:
        return {}
    values = (model.distortion.offset_y_mm, *model.distortion.coefficients)
    return dict(zip(model.parameter_names[PARAMETER_COUNT:], values, strict=True))


def _positions(
    one: Calibration, other: Calibration, low_mm: Array, high_mm: Array
) -> PositionDifferences | None:
    points = box_points(low_mm, high_mm, _SIDE)
    readings = predicted_readings(one, points)
    covariance = np.array(other.covariance)
    # The readings have no noise here: what is uncertain is the calibrations' own.
    exact = np.full(readings.shape, _EXACT_PX)
    found = reconstruct(other.models, readings, exact, covariance)
    first = reconstruct(one.models, readings, exact, np.array(one.covariance))
    known = np.isfinite(found.position_mm).all(axis=1) & np.isfinite(first.position_mm).all(axis=1)
    if known.sum() < 4:
        return None
    given, other_mm = points[known], found.position_mm[known]
    difference = other_mm - given
    covariance_mm2 = found.covariance_mm2[known] + first.covariance_mm2[known]
    squares = np.einsum("ni,nij,nj->n", difference, np.linalg.pinv(covariance_mm2), difference)
    other_centred, given_centred = other_mm - other_mm.mean(axis=0), given - given.mean(axis=0)
    rotation, _ = Rotation.align_vectors(other_centred, given_centred)
    aligned = other_centred - rotation.apply(given_centred)
    distance = np.linalg.norm(difference, axis=1)
    rms_sigma = float(np.sqrt(squares.mean() / 3.0))
    return PositionDifferences(
        points=int(known.sum()),
        low_mm=vector3(low_mm),
        high_mm=vector3(high_mm),
        mean_mm=vector3(difference.mean(axis=0)),
        rms_mm=_rms(difference),
        max_mm=float(distance.max()),
        aligned_rms_mm=_rms(aligned),
        rms_sigma=rms_sigma if np.isfinite(rms_sigma) else None,
    )


def predicted_readings(calibration: Calibration, points_mm: Array) -> Array:
    """Return what the sensors read of points, shape (N, S) [px]; NaN beyond their pixels."""
    readings = CameraStack.of(calibration.models).project(points_mm)
    pixels = np.array([model.pixels for model in calibration.models])
    with np.errstate(invalid="ignore"):
        readings[(readings < -0.5) | (readings > pixels - 0.5)] = np.nan
    return readings


def _same_observations(
    of: Literal["one", "other"],
    one: CalibrationWithControlPoints,
    other: CalibrationWithControlPoints,
) -> SameObservations | None:
    owner = one if of == "one" else other
    errors = [_errors(held, owner) for held in (one, other)]
    known = np.isfinite(errors[0]).all(axis=1) & np.isfinite(errors[1]).all(axis=1)
    if not known.any():
        return None
    first, second = errors[0][known], errors[1][known]
    gain = (first**2).sum(axis=1) - (second**2).sum(axis=1)
    better: Literal["one", "other", "neither"] = "neither"
    if len(gain) > 2 and abs(gain.mean()) > _DECISIVE * gain.std(ddof=1) / np.sqrt(len(gain)):
        better = "other" if gain.mean() > 0 else "one"
    return SameObservations(
        of=of,
        points=int(known.sum()),
        one_rms_mm=_rms(first),
        other_rms_mm=_rms(second),
        left_out=owner.left_out_mm is not None,
        better=better,
    )


def _errors(held: CalibrationWithControlPoints, owner: CalibrationWithControlPoints) -> Array:
    """Return the errors of the owner's points, by a calibration that never saw them if known."""
    if held is owner and owner.left_out_mm is not None:
        return owner.left_out_mm
    used, _ = effective_readings(owner.calibration, owner.readings_px)
    return fitted_errors(held.calibration, owner.points_mm, used)


def _rms(rows_mm: Array) -> float:
    return float(np.sqrt((rows_mm**2).sum(axis=1).mean()))
