"""Absolute orientation: the rigid transform, or similarity, between two sets of paired points."""

from dataclasses import dataclass, replace
from functools import partial
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.errors import NoConvergence
from compute.transform import cross_matrix, nearest_rotation, point_jacobian, rotation_matrix

Array = NDArray[np.float64]

_STEPS: Final = 200
_HALVINGS: Final = 40


@dataclass(frozen=True, eq=False)
class Similarity:
    """Similarity transform ``target = scale * rotation @ source + translation_mm``.

    Args:
        rotation: shape (3, 3).
        translation_mm: shape (3,) [mm].
        scale: 1 for a rigid transform.
    """

    rotation: Array
    translation_mm: Array
    scale: float = 1.0

    def apply(self, points_mm: Array) -> Array:
        """Return points (..., 3) of the source in the target's frame [mm]."""
        moved: Array = self.scale * (points_mm @ self.rotation.T) + self.translation_mm
        return moved

    def jacobian(self, points_mm: Array, scaled: bool) -> Array:
        """Return the Jacobian of ``apply``, shape (..., 3, 6 or 7).

        Its columns are rotation (left) [rad], translation [mm] and, if ``scaled``, log scale.

        Args:
            points_mm: points of the source, shape (..., 3) [mm].
            scaled: whether the scale is free.
        """
        turned = self.scale * (points_mm @ self.rotation.T)
        rigid = point_jacobian(turned)
        return np.concatenate([rigid, turned[..., None]], axis=-1) if scaled else rigid

    def residual_covariance(self, source_covariance: Array, target_covariance: Array) -> Array:
        """Return the covariances of ``apply(source) - target``, shape (N, 3, 3) [mm^2].

        Args:
            source_covariance: shape (N, 3, 3) [mm^2].
            target_covariance: shape (N, 3, 3) [mm^2].
        """
        linear = self.scale * self.rotation
        covariance: Array = linear @ source_covariance @ linear.T + target_covariance
        return covariance

    def retract(self, step: Array) -> "Similarity":
        """Return the similarity corrected by an increment of its 6 or 7 parameters."""
        return Similarity(
            nearest_rotation(rotation_matrix(step[:3]) @ self.rotation),
            self.translation_mm + step[3:6],
            self.scale * float(np.exp(step[6])) if len(step) == 7 else self.scale,
        )


def fit_isotropic_similarity(
    source: Array, target: Array, weights: Array, scaled: bool = False
) -> Similarity:
    """Return the least-squares transform for isotropic errors.

    In closed form (Kabsch, doi:10.1107/S0567739478001680; Horn, doi:10.1364/JOSAA.4.000629; with
    scale Umeyama, doi:10.1109/34.88573).

    Args:
        source: shape (N, 3) [mm].
        target: shape (N, 3) [mm].
        weights: shape (N,).
        scaled: whether the scale is free.
    """
    share = weights / weights.sum()
    centre, goal = share @ source, share @ target
    x, y = source - centre, target - goal
    cross_covariance = (share[:, None] * y).T @ x
    rotation = nearest_rotation(cross_covariance)
    scale = 1.0
    if scaled:
        scale = float(np.trace(rotation.T @ cross_covariance) / (share @ (x**2).sum(axis=1)))
    return Similarity(rotation, goal - scale * rotation @ centre, scale)


@dataclass(frozen=True, eq=False)
class SimilarityFit:
    """A fit of paired points.

    Args:
        similarity: the transform.
        covariance: covariance of rotation, translation and, if free, log scale, shape (6, 6) or
            (7, 7).
        residual_mm: ``apply(source) - target``, shape (N, 3) [mm].
        chi2: chi2 of the residuals with the given covariances.
    """

    similarity: Similarity
    covariance: Array
    residual_mm: Array
    chi2: float


def fit_weighted_similarity(
    source: Array,
    target: Array,
    source_covariance: Array,
    target_covariance: Array,
    scaled: bool = False,
) -> SimilarityFit:
    """Return the maximum-likelihood transform for anisotropic errors.

    Each pair is weighted with ``s^2 R Cs R' + Ct``. The weights rotate with the transform, as in
    R. Balachandran and J. M. Fitzpatrick (doi:10.1117/12.813874), and the sources are adjusted
    within their covariances. The iteration starts from the isotropic solution.

    Args:
        source: shape (N, 3) [mm].
        target: shape (N, 3) [mm].
        source_covariance: shape (N, 3, 3) [mm^2]; may be zero.
        target_covariance: shape (N, 3, 3) [mm^2]; the sum of both is positive definite.
        scaled: whether the scale is free.

    Raises:
        NoConvergence: the iteration did not converge.
    """
    size = np.trace(source_covariance + target_covariance, axis1=1, axis2=2)
    # About the centroid rotation and translation are least correlated.
    centre = source.mean(axis=0)
    centred = source - centre
    similarity = fit_isotropic_similarity(centred, target, 1.0 / size, scaled)
    length = float(np.sqrt((centred**2).sum(axis=1).mean()))
    misfit = partial(
        _misfit,
        source=centred,
        target=target,
        source_covariance=source_covariance,
        target_covariance=target_covariance,
    )
    chi2, information, residual = misfit(similarity)
    for _ in range(_STEPS):
        linear = similarity.scale * similarity.rotation
        pull = np.einsum("nij,nj->ni", information, residual)
        adjusted = centred - np.einsum("nij,kj,nk->ni", source_covariance, linear.T, pull)
        jacobian = similarity.jacobian(adjusted, scaled)
        normal = np.einsum("nia,nij,njb->ab", jacobian, information, jacobian, optimize=True)
        step = -np.linalg.solve(normal, np.einsum("nia,ni->a", jacobian, pull))
        # With exchanged points full steps may oscillate.
        for _ in range(_HALVINGS):
            tried = similarity.retract(step)
            after = misfit(tried)
            if after[0] <= chi2 * (1.0 + 1e-12) + 1e-15:
                break
            step = 0.5 * step
        similarity, (chi2, information, residual) = tried, after
        # In standard deviations of the result; where these are as small as rounding, in lengths.
        size = np.abs(step[:3]).max() * length + np.abs(step[3:6]).max()
        if step @ normal @ step < 1e-12 * (1.0 + chi2) or size < 1e-12 * length:
            break
    else:
        raise NoConvergence(
            f"the registration did not converge in {_STEPS} steps; the last turned it by "
            f"{np.linalg.norm(step[:3]):.2g} rad and shifted it by "
            f"{np.linalg.norm(step[3:6]):.2g} mm"
        )
    covariance = np.linalg.inv(normal)
    # Back from the centroid: t = t_centroid - s R centroid.
    swept = -similarity.scale * similarity.rotation @ centre
    shift = np.eye(len(covariance))
    shift[3:6, :3] = -cross_matrix(swept)
    if scaled:
        shift[3:6, 6] = swept
    return SimilarityFit(
        replace(similarity, translation_mm=similarity.translation_mm + swept),
        shift @ covariance @ shift.T,
        residual,
        chi2,
    )


def _misfit(
    similarity: Similarity,
    source: Array,
    target: Array,
    source_covariance: Array,
    target_covariance: Array,
) -> tuple[float, Array, Array]:
    """Return chi2, the information of each pair (N, 3, 3), and the residuals (N, 3)."""
    covariance = similarity.residual_covariance(source_covariance, target_covariance)
    information = np.asarray(np.linalg.inv(covariance), np.float64)
    residual = similarity.apply(source) - target
    chi2 = float(np.einsum("ni,nij,nj->", residual, information, residual))
    return chi2, information, residual
