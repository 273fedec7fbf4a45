"""PoseEquations: least-squares equations of a tool's pose from its readings, and their solution."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dposv

from compute.measurement.measurement_model import MeasurementModel
from compute.pose.rigid_body import CentredMarkers
from compute.transform import exp_so3, rotation_matrix

Array = NDArray[np.float64]

MAX_ITERATIONS = 40
INITIAL_DAMPING = 1e-6
MAX_DAMPING = 1e12
STEP_TOLERANCE_MM = 1e-6
"""Convergence is quadratic: the next step would be far below rounding."""
ROUNDING_TOLERANCE = 1.0 + 1e-10
_DIAGONAL = np.arange(6)


@dataclass(frozen=True, eq=False)
class PoseCandidates:
    """K poses of a tool, and the whitened equations there.

    Args:
        rotation: R_world_tool, shape (K, 3, 3).
        centroid_mm: centroid of the markers in the world, shape (K, 3) [mm].
        gram: Gram matrices ``[J r]' [J r]`` of the whitened Jacobian with respect to (rotation
            times radius, centroid) and residuals, shape (K, 7, 7); NaN where a marker is behind a
            lens.
        converged: whether the iteration converged, shape (K,).
    """

    rotation: Array
    centroid_mm: Array
    gram: Array
    converged: NDArray[np.bool_]

    @property
    def chi2(self) -> Array:
        """Weighted sums of squares, shape (K,); infinite where undefined or not converged."""
        chi2 = self.gram[:, 6, 6]
        return np.where(np.isfinite(chi2) & self.converged, chi2, np.inf)

    def of(self, rows: NDArray[np.intp]) -> "PoseCandidates":
        """Return the poses at the given indices."""
        return PoseCandidates(*(getattr(self, name)[rows] for name in vars(self)))


@dataclass(frozen=True, eq=False)
class PoseEquations:
    """n readings of a tool as equations for its pose.

    Args:
        model: the cameras.
        centred: the tool's markers.
        readings_px: raw readings, shape (M, S) [px]; NaN where not used.
        sigma_px: their standard deviations, shape (M, S) [px].
    """

    model: MeasurementModel
    centred: CentredMarkers
    readings_px: Array
    sigma_px: Array

    @cached_property
    def used(self) -> NDArray[np.bool_]:
        """Mask of the readings that are used, shape (M, S)."""
        return np.isfinite(self.readings_px)

    @cached_property
    def _flat(self) -> NDArray[np.intp]:
        return np.flatnonzero(self.used)

    @cached_property
    def _marker(self) -> NDArray[np.intp]:
        return self._flat // len(self.model)

    @cached_property
    def _measured(self) -> Array:
        return self.readings_px.ravel()[self._flat]

    @cached_property
    def independent_whitening(self) -> Array:
        """Whitening by the readings' own noise alone, its diagonal, shape (n,)."""
        return 1.0 / self.sigma_px.ravel()[self._flat]

    @property
    def has_independent_noise(self) -> bool:
        """Whether the readings' errors are independent: exact cameras, no correction table."""
        return self.model.corrections is None and self.model.covariance_factor.shape[2] == 0

    def lever_arms(self, rotation: Array) -> Array:
        """Return the markers about their centroid along the world's axes, shape (K, M, 3)."""
        arms: Array = self.centred.markers_mm @ rotation.swapaxes(-1, -2)
        return arms

    def rows(self, rotation: Array, centroid_mm: Array) -> Array:
        """Return Jacobian and residuals side by side, not whitened, shape (K, n, 7).

        Args:
            rotation: R_world_tool, shape (K, 3, 3).
            centroid_mm: centroid of the markers, shape (K, 3) [mm].
        """
        lever_arms = self.lever_arms(rotation)
        positions = (lever_arms + centroid_mm[:, None, :]).reshape(-1, 3)
        value, slope = self.model.linearise(positions)
        count = len(rotation)
        slope = slope.reshape(count, -1, 3)[:, self._flat]
        rows = np.empty((count, len(self._flat), 7))
        rotation_jacobian(lever_arms[:, self._marker], slope, rows)
        rows[..., :3] /= self.centred.radius_mm
        rows[..., 3:6] = slope
        rows[..., 6] = self._measured - value.reshape(count, -1)[:, self._flat]
        return rows

    def covariance(self, rotation: Array, centroid_mm: Array) -> Array:
        """Return the readings' joint covariance at a pose, shape (n, n) [px^2].

        The sum of their noise, the correction table's variance, and the calibration's part, which
        is common to all markers: no number of markers averages it away.

        Args:
            rotation: R_world_tool, shape (3, 3).
            centroid_mm: centroid of the markers, shape (3,) [mm].
        """
        positions = self.lever_arms(rotation) + centroid_mm
        expected = self.model.predict(positions, with_common_errors=True)
        variance = self.sigma_px**2 + expected.table_variance_px2
        covariance = np.diag(variance.ravel()[self._flat])
        if expected.common_jacobian_px.shape[2]:
            common = expected.common_jacobian_px[self.used]
            covariance += common @ common.T
        return covariance

    def whitening(self, rotation: Array, centroid_mm: Array) -> Array:
        """Return W with ``W covariance W' = 1`` at a pose, shape (n, n).

        Args:
            rotation: R_world_tool, shape (3, 3).
            centroid_mm: centroid of the markers, shape (3,) [mm].
        """
        root = np.linalg.cholesky(self.covariance(rotation, centroid_mm))
        return np.asarray(np.linalg.inv(root), dtype=np.float64)

    def gram(self, rotation: Array, centroid_mm: Array, whitening: Array) -> Array:
        """Return the Gram matrices of the whitened equations, shape (K, 7, 7).

        Args:
            rotation: R_world_tool, shape (K, 3, 3).
            centroid_mm: centroids of the markers, shape (K, 3) [mm].
            whitening: W, shape (n, n), or its diagonal, shape (n,).
        """
        rows = self.rows(rotation, centroid_mm)
        rows = whitening @ rows if whitening.ndim == 2 else whitening[:, None] * rows
        gram: Array = rows.transpose(0, 2, 1) @ rows
        return gram

    def refine(
        self, rotation: Array, centroid_mm: Array, whitening: Array, most: int = MAX_ITERATIONS
    ) -> PoseCandidates:
        """Refine K poses by Levenberg-Marquardt on SE(3).

        Rotation increments act on the left, about the centroid.

        Args:
            rotation: initial R_world_tool, shape (K, 3, 3).
            centroid_mm: initial centroids of the markers, shape (K, 3) [mm].
            whitening: W, shape (n, n), or its diagonal, shape (n,).
            most: largest number of iterations.
        """
        if len(rotation) == 1:
            return self._refine_one(rotation[0], centroid_mm[0], whitening, most)
        rotation, centroid = rotation.copy(), centroid_mm.copy()
        gram = self.gram(rotation, centroid, whitening)
        damping = np.full(len(rotation), INITIAL_DAMPING)
        converged = np.zeros(len(rotation), dtype=np.bool_)
        index = np.flatnonzero(np.isfinite(gram[:, 6, 6]))
        for _ in range(most):
            if len(index) == 0:
                break
            step = _solve(gram[index], damping[index])
            turned = rotation_matrix(step[:, :3] / self.centred.radius_mm) @ rotation[index]
            moved = centroid[index] + step[:, 3:]
            trial = self.gram(turned, moved, whitening)
            small = np.abs(step).max(axis=1) <= STEP_TOLERANCE_MM
            better = trial[:, 6, 6] <= ROUNDING_TOLERANCE * gram[index, 6, 6]
            better |= small & np.isfinite(trial[:, 6, 6])
            accepted = index[better]
            rotation[accepted], centroid[accepted] = turned[better], moved[better]
            gram[accepted] = trial[better]
            damping[index] *= np.where(better, 0.1, 10.0)
            converged[index] = small
            index = index[~small & (damping[index] < MAX_DAMPING)]
        return PoseCandidates(rotation, centroid, gram, converged)

    def _refine_one(
        self, rotation: Array, centroid_mm: Array, whitening: Array, most: int
    ) -> PoseCandidates:
        """Refine one pose: ``refine`` in fewer calls, for tracking and repeated fits."""
        centroid = centroid_mm
        gram = self._gram_one(rotation, centroid, whitening)
        damping, converged = INITIAL_DAMPING, False
        for _ in range(most if np.isfinite(gram[6, 6]) else 0):
            normal = gram[:6, :6].copy()
            diagonal = normal.flat[::7]
            normal.flat[::7] = diagonal + (
                damping * diagonal + (1e-300 + 1e-15 * float(diagonal.max()))
            )
            _, step, failed = dposv(normal, gram[:6, 6])
            if failed:
                damping *= 10.0
                continue
            turned = exp_so3(step[:3] / self.centred.radius_mm) @ rotation
            moved = centroid + step[3:]
            trial = self._gram_one(turned, moved, whitening)
            converged = bool(np.abs(step).max() <= STEP_TOLERANCE_MM)
            if trial[6, 6] <= ROUNDING_TOLERANCE * gram[6, 6] or (
                converged and np.isfinite(trial[6, 6])
            ):
                rotation, centroid, gram = turned, moved, trial
                damping *= 0.1
            else:
                damping *= 10.0
            if converged or damping >= MAX_DAMPING:
                break
        return PoseCandidates(rotation[None], centroid[None], gram[None], np.array([converged]))

    def _gram_one(self, rotation: Array, centroid_mm: Array, whitening: Array) -> Array:
        """Return the Gram matrix of the whitened equations of one pose, shape (7, 7)."""
        lever_arms = self.centred.markers_mm @ rotation.T
        value, slope = self.model.linearise(lever_arms + centroid_mm)
        slope = slope.reshape(-1, 3)[self._flat]
        rows = np.empty((len(self._flat), 7))
        rotation_jacobian(lever_arms[self._marker], slope, rows)
        rows[:, :3] /= self.centred.radius_mm
        rows[:, 3:6] = slope
        rows[:, 6] = self._measured - value.ravel()[self._flat]
        rows = whitening @ rows if whitening.ndim == 2 else whitening[:, None] * rows
        gram: Array = rows.T @ rows
        return gram


def rotation_jacobian(arm_mm: Array, gradient_px_per_mm: Array, into: Array) -> None:
    """Write d reading / d rotation, ``arm x gradient``, to the first three columns of an array.

    Args:
        arm_mm: marker less centroid along the world's axes, shape (..., 3) [mm].
        gradient_px_per_mm: d reading / d position, shape (..., 3) [px/mm].
        into: the Jacobian that is written to, shape (..., 3 or more) [px/rad].
    """
    ax, ay, az = arm_mm[..., 0], arm_mm[..., 1], arm_mm[..., 2]
    gx, gy, gz = gradient_px_per_mm[..., 0], gradient_px_per_mm[..., 1], gradient_px_per_mm[..., 2]
    into[..., 0] = ay * gz - az * gy
    into[..., 1] = az * gx - ax * gz
    into[..., 2] = ax * gy - ay * gx


def _solve(gram: Array, damping: Array) -> Array:
    """Return the damped steps, shape (K, 6)."""
    normal = gram[:, :6, :6].copy()
    diagonal = normal[:, _DIAGONAL, _DIAGONAL]
    floor = 1e-300 + 1e-15 * diagonal.max(axis=1, keepdims=True)
    normal[:, _DIAGONAL, _DIAGONAL] += damping[:, None] * diagonal + floor
    return np.asarray(np.linalg.solve(normal, gram[:, :6, 6:])[..., 0], dtype=np.float64)
