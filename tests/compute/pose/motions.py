"""Random rigid motions and configurations, and the bounds of what statistics may come to."""

import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.stats import chi2

from compute.transform import Transform, rotation_matrix

Array = NDArray[np.float64]


def vectors(size: float) -> st.SearchStrategy[Array]:
    """Vectors in space with components up to a size."""
    return st.tuples(*[st.floats(-size, size)] * 3).map(np.array)


def seeds() -> st.SearchStrategy[np.random.Generator]:
    """Generators of what a test draws."""
    return st.integers(0, 2**32 - 1).map(np.random.default_rng)


def transforms(covariance: bool = True) -> st.SearchStrategy[Transform]:
    """Any rotation, a translation within a metre, a covariance of some mrad and tenths of a mm."""

    def make(turn: Array, shift: Array, chance: np.random.Generator) -> Transform:
        return Transform.from_rotation_vector(
            turn, shift, pose_covariance(chance) if covariance else None
        )

    return st.builds(make, vectors(3.0), vectors(1000.0), seeds())


def pose_covariance(chance: np.random.Generator) -> Array:
    """Return a covariance (6, 6) of some 1 mrad and 0.1 mm, none of it independent."""
    mixed = chance.normal(size=(6, 6))
    scale = np.diag([1e-3] * 3 + [0.1] * 3)
    return scale @ (mixed @ mixed.T / 6.0 + 0.1 * np.eye(6)) @ scale


def point_covariance(chance: np.random.Generator, sigma_mm: float) -> Array:
    """Return an anisotropic covariance (3, 3)."""
    mixed = chance.normal(size=(3, 3))
    return sigma_mm**2 * (mixed @ mixed.T / 3.0 + 0.05 * np.eye(3))


def drawn(chance: np.random.Generator, covariances: Array) -> Array:
    """Return an error of each covariance (N, D, D), shape (N, D)."""
    factors = np.linalg.cholesky(covariances)
    return np.einsum("nij,nj->ni", factors, chance.normal(size=covariances.shape[:2]))


def disturbed(
    chance: np.random.Generator, rotations: Array, translations: Array, covariances: Array
) -> tuple[Array, Array]:
    """Return poses with errors of their covariances."""
    error = drawn(chance, covariances)
    return rotation_matrix(error[:, :3]) @ rotations, translations + error[:, 3:]


def check_mean(values: list[float], freedom: float, slack: float = 0.0) -> None:
    """Check that values of chi-square distributions average what they should.

    Args:
        values: independent of one another.
        freedom: of each.
        slack: share by which the average may be off besides, where theory is of first order.
    """
    count = len(values)
    low, high = chi2.ppf([1e-4, 1.0 - 1e-4], count * freedom) / count
    assert low * (1.0 - slack) <= np.mean(values) <= high * (1.0 + slack), np.mean(values)
