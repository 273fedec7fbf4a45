"""Registration by paired points."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from compute.pose.registration.point_registration import register_points
from service.api.tools.registration_schema import NewPairedPoints

Array = NDArray[np.float64]


def paired(request: NewPairedPoints) -> dict[str, Any]:
    """Return what the paired points give, as it is stored.

    Raises:
        CollinearPoints, DuplicatePoint, TooFewPoints, InvalidParameter, NoConvergence.
    """
    pairs = request.fiducials
    names = [pair.name for pair in pairs]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise InvalidParameter(f'two fiducials are called "{twice}"; give each a name of its own')
    found = register_points(
        np.array([pair.frame_mm for pair in pairs]),
        np.array([pair.measured_mm for pair in pairs]),
        None if request.frame_sigma_mm is None else request.frame_sigma_mm**2 * np.eye(3),
        _measured_covariance(request),
        names=names,
    )
    targets = np.array([target.frame_mm for target in request.targets]).reshape(-1, 3)
    return {
        "matrix": found.transform.matrix.tolist(),
        "covariance": found.parameter_covariance[:6, :6].tolist(),
        "fre_mm": found.fre_mm,
        "fle_mm": found.fle_mm,
        "residual_sigma": found.residual_sigma,
        "fiducials": [
            {
                "name": name,
                "residual_mm": residual.tolist(),
                "error_mm": float(np.linalg.norm(residual)),
            }
            for name, residual in zip(names, found.residual_mm, strict=True)
        ],
        "targets": [
            {"name": target.name, "error_mm": float(error), "covariance_mm2": spread.tolist()}
            for target, error, spread in zip(
                request.targets,
                found.target_error(targets),
                found.target_covariance(targets),
                strict=True,
            )
        ],
        "warnings": list(found.warnings),
    }


def _measured_covariance(request: NewPairedPoints) -> Array | None:
    own = [pair.measured_covariance_mm2 for pair in request.fiducials]
    sigma = request.measured_sigma_mm
    if sigma is None:
        given = [one is not None for one in own]
        if not any(given):
            return None
        if not all(given):
            name = request.fiducials[given.index(False)].name
            raise InvalidParameter(
                f'fiducial "{name}" has no covariance and others have; give all of them one, or '
                "measured_sigma_mm for those without"
            )
    alike = np.eye(3) * (sigma or 0.0) ** 2
    return np.array([alike if one is None else np.array(one) for one in own])
