"""Many weighted fits of one 1D camera at once, in its projective form of seven numbers."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.calibration.single_sensor.normalised_dlt import normalisation

Array = NDArray[np.float64]

PARAMETER_COUNT_PROJECTIVE = 7
MIN_RELATIVE_DEPTH = 0.05
"""Smallest depth of a point in a trial camera, the centroid's being 1."""
DAMPING_FLOOR, DAMPING_CEILING = 1e-12, 1e8


@dataclass(frozen=True, eq=False)
class ProjectiveCamera:
    """Control points, ready for cameras ``p = (a.X + b) / (1 + g.X)`` with theta = (a, b, g).

    All points lie in front of a camera and so does their centroid, the origin here: no camera
    that matters is left out by setting the depth there to 1, as [5.1] does at the world's origin.

    Args:
        points: control points in the frame of ``normalisation``, shape (N, 3).
        centre_px: subtracted from readings.
        scale_px: readings are divided by it.
        extra: columns that readings may have linearly besides (a lens's distortion), in units of
            ``scale_px``, shape (N, K); None: none. theta has their K coefficients at its end.
        offset_px: what is added to the reading at each point whatever theta is, shape (N,) [px];
            None: nothing.
    """

    points: Array
    centre_px: float
    scale_px: float
    extra: Array | None = None
    offset_px: Array | None = None

    @property
    def width(self) -> int:
        """Number of parameters: 7 + K."""
        return PARAMETER_COUNT_PROJECTIVE + (0 if self.extra is None else self.extra.shape[1])

    @classmethod
    def of(cls, points_mm: Array, readings_px: Array) -> "ProjectiveCamera":
        """Prepare points (N, 3) and the readings (N,) of one sensor; NaN where not seen."""
        seen = np.isfinite(readings_px)
        transform = normalisation(points_mm[seen])
        points = points_mm @ transform[:3, :3].T + transform[:3, 3]
        return cls(points, float(readings_px[seen].mean()), float(readings_px[seen].std()) or 1.0)

    @property
    def zero_px(self) -> Array | float:
        """What a reading is counted from: ``centre_px`` and the offset, (N,) or one number."""
        return self.centre_px if self.offset_px is None else self.centre_px + self.offset_px

    def project(self, theta: Array) -> Array:
        """Return the readings of cameras (K, width), shape (K, N) [px]."""
        numerator = theta[:, :3] @ self.points.T + theta[:, 3:4]
        readings: Array = numerator / (1.0 + theta[:, 4:PARAMETER_COUNT_PROJECTIVE] @ self.points.T)
        if self.extra is not None:
            readings += theta[:, PARAMETER_COUNT_PROJECTIVE:] @ self.extra.T
        return np.asarray(readings * self.scale_px + self.zero_px)

    def linearise(self, theta: Array) -> tuple[Array, Array]:
        """Return readings (K, N) [px] and their slopes by theta, shape (K, N, width)."""
        depth = 1.0 + theta[:, 4:PARAMETER_COUNT_PROJECTIVE] @ self.points.T
        readings = (theta[:, :3] @ self.points.T + theta[:, 3:4]) / depth
        jacobian = np.empty((*readings.shape, self.width))
        jacobian[..., :3] = self.points / depth[..., None]
        jacobian[..., 3] = 1.0 / depth
        jacobian[..., 4:PARAMETER_COUNT_PROJECTIVE] = -readings[..., None] * jacobian[..., :3]
        if self.extra is not None:
            jacobian[..., PARAMETER_COUNT_PROJECTIVE:] = self.extra
            readings = readings + theta[:, PARAMETER_COUNT_PROJECTIVE:] @ self.extra.T
        jacobian *= self.scale_px
        return readings * self.scale_px + self.zero_px, jacobian

    def algebraic(self, readings_px: Array, weights: Array) -> Array:
        """Solve [5.5] for readings (K, N) with weights (K, N), 0 for none; theta (K, width)."""
        zero = self.zero_px
        q = (np.where(weights > 0.0, readings_px, zero) - zero) / self.scale_px
        design = np.empty((*q.shape, PARAMETER_COUNT_PROJECTIVE))
        design[..., :3] = self.points
        design[..., 3] = 1.0
        design[..., 4:] = -q[..., None] * self.points
        design *= weights[..., None]
        found = self._in_front(_solve(design, q * weights, 1e-12))
        return np.pad(found, ((0, 0), (0, self.width - PARAMETER_COUNT_PROJECTIVE)))

    def fit(self, readings_px: Array, weights: Array, theta: Array, steps: int) -> Array:
        """Minimise the weighted squares by Levenberg-Marquardt from theta (K, width).

        Args:
            readings_px: shape (K, N); anything finite where the weight is 0.
            weights: 1 / standard deviation, shape (K, N) [1/px]; 0: left out.
            theta: starting cameras with all points in front.
            steps: trial steps at most; ends when no camera gains by one.
        """
        found = theta.copy()
        active = np.arange(len(theta))
        damping = np.full(len(theta), 1e-4)
        cost = self._cost(theta, readings_px, weights)
        for _ in range(steps):
            fitted, jacobian = self.linearise(theta)
            jacobian *= weights[..., None]
            step = _solve(jacobian, (readings_px - fitted) * weights, damping)
            trial = self._in_front(theta + step)
            new = self._cost(trial, readings_px, weights)
            better, gain = new < cost, cost - new
            theta = np.where(better[:, None], trial, theta)
            damping *= np.where(better, 0.1, 10.0)
            damping = np.minimum(np.maximum(damping, DAMPING_FLOOR), DAMPING_CEILING)
            least = 1e-9 * cost
            settled = np.where(
                better, gain <= least, (gain >= -least) | (damping >= DAMPING_CEILING)
            )
            cost = np.where(better, new, cost)
            if settled.any():
                found[active] = theta
                going = ~settled
                active, theta = active[going], theta[going]
                cost, damping = cost[going], damping[going]
                readings_px, weights = readings_px[going], weights[going]
                if len(active) == 0:
                    break
        found[active] = theta
        return found

    def _cost(self, theta: Array, readings_px: Array, weights: Array) -> Array:
        misfit = self.project(theta)
        misfit -= readings_px
        misfit *= weights
        squares: Array = np.einsum("kn,kn->k", misfit, misfit)
        return squares

    def _in_front(self, theta: Array) -> Array:
        """Flatten the depth's slope where a point would come too near or behind."""
        lowest = (theta[:, 4:PARAMETER_COUNT_PROJECTIVE] @ self.points.T).min(axis=1)
        if lowest.min() >= MIN_RELATIVE_DEPTH - 1.0:
            return theta
        shrink = np.minimum(1.0, (1.0 - MIN_RELATIVE_DEPTH) / np.maximum(-lowest, 1e-12))
        theta = theta.copy()
        theta[:, 4:PARAMETER_COUNT_PROJECTIVE] *= shrink[:, None]
        return theta


def _solve(design: Array, right: Array, damping: Array | float) -> Array:
    """Solve least squares (K, N, 7) x (K, 7) = (K, N), each damped by its own diagonal."""
    transposed = design.swapaxes(1, 2)
    normal = transposed @ design
    here = np.arange(design.shape[2])
    # Columns of length 1, by the diagonal: their products are fewer than their values.
    scale = 1.0 / (np.sqrt(normal[:, here, here]) + 1e-150)
    normal *= scale[:, :, None] * scale[:, None, :]
    normal[:, here, here] += (damping if isinstance(damping, float) else damping[:, None]) + 1e-13
    slope = (transposed @ right[..., None])[..., 0] * scale
    step: Array = np.linalg.solve(normal, slope[..., None])[..., 0] * scale
    return step
