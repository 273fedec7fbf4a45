"""Reliability of a pose: detectable errors of a reading, and the effect of undetected ones."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.pose.estimation.pose_equations import PoseEquations
from compute.pose.settings import POSE_PARAMETERS
from compute.reliability import check_readings, noncentrality

Array = NDArray[np.float64]

PIVOT_FLOOR: Final = 1e-10
"""Smallest pivot of the normal equations, as a share of their diagonal; below it the readings do
not determine the pose."""


@dataclass(frozen=True, eq=False)
class PoseReliability:
    """Reliability of a pose that its n readings determine, as W. Baarda defines it (1968).

    Args:
        detectable_sigma: largest minimal detectable bias of a reading, which the chi-square test
            finds with a probability of 0.8, in standard deviations of the reading; infinite where
            the others do not check a reading.
        marker: index of the marker of that reading.
        sensor: index of its sensor.
        external_tip_mm: largest shift of the tip by an error of its reading's detectable size.
        external_rotation_rad: largest rotation by one.
    """

    detectable_sigma: float
    marker: int
    sensor: int
    external_tip_mm: float
    external_rotation_rad: float

    def low_reason(self, limit: float) -> str | None:
        """Return why an error above ``limit`` standard deviations may pass; None: it may not."""
        if self.detectable_sigma <= limit:
            return None
        where = f"the reading of marker {self.marker + 1} by sensor {self.sensor + 1}"
        if not np.isfinite(self.detectable_sigma):
            return f"nothing checks {where}: any error of it would pass"
        return (
            f"an error of {where} would be found from {self.detectable_sigma:.3g} of its standard "
            f"deviations on (at most {limit:g} are allowed); a smaller one may shift the tip by "
            f"{self.external_tip_mm:.3g} mm"
        )


def pose_reliability(
    equations: PoseEquations, rotation: Array, centroid_mm: Array, significance: float
) -> PoseReliability:
    """Return the reliability of the pose of some readings.

    Args:
        equations: the readings.
        rotation: the pose's R_world_tool, shape (3, 3).
        centroid_mm: centroid of the markers, shape (3,) [mm].
        significance: of the chi-square test.
    """
    centred = equations.centred
    marker, sensor = np.nonzero(equations.used)
    if len(marker) <= POSE_PARAMETERS:
        return _unchecked(marker, sensor)
    rows = equations.rows(rotation[None], centroid_mm[None])[0]
    covariance = equations.covariance(rotation, centroid_mm)
    whitening = np.linalg.inv(np.linalg.cholesky(covariance))
    design = whitening @ rows[:, :6]
    if not _determine_pose(design.T @ design):
        return _unchecked(marker, sensor)
    checks = check_readings(rows[:, :6], rows[:, 6], whitening)
    size = checks.detectable_px(noncentrality(len(rows) - POSE_PARAMETERS, significance))
    in_sigma = size / np.sqrt(covariance.diagonal())
    worst = int(in_sigma.argmax())
    influence = checks.influence.copy()
    influence[:3] /= centred.radius_mm
    tip = np.linalg.norm(centred.tip_jacobian(rotation) @ influence, axis=0) * size
    rotation_mm = np.linalg.norm(influence[:3], axis=0) * size
    return PoseReliability(
        float(in_sigma[worst]),
        int(marker[worst]),
        int(sensor[worst]),
        float(tip.max()),
        float(rotation_mm.max()),
    )


def _determine_pose(normal: Array) -> bool:
    """Return whether normal equations (6, 6) have one solution."""
    try:
        pivots = np.linalg.cholesky(normal).diagonal() ** 2
    except np.linalg.LinAlgError:
        return False
    return bool((pivots > PIVOT_FLOOR * normal.diagonal()).all())


def _unchecked(marker: NDArray[np.intp], sensor: NDArray[np.intp]) -> PoseReliability:
    """Return the reliability of a pose whose readings do not check one another."""
    first = (int(marker[0]), int(sensor[0])) if len(marker) else (0, 0)
    return PoseReliability(np.inf, *first, np.inf, np.inf)
