"""Fresnel equations: transmittance of a bare surface."""

import numpy as np

from compute.errors import InvalidParameter
from compute.optics.tracing.shapes import Array


def transmittances(cos_incidence: Array, index_before: float, index_behind: float) -> Array:
    """Return the shares of the power that pass, for s and p, shape (..., 2).

    Power and not intensity: the factor ``n cos`` of both sides is in it. Total reflection gives 0.

    Args:
        cos_incidence: cosines of the angles of incidence, 0 to 1, shape (...).
        index_before: refractive index on the side of the incident light.
        index_behind: refractive index behind the surface.

    Raises:
        InvalidParameter: a cosine outside 0 .. 1, an index outside 1 .. 10.

    Source: Born & Wolf, Principles of Optics, 1.5.2 (20a), 1.5.3.
    """
    # Where all is reflected the outer cosine is zero, and so is the share.
    inner, outer = _cosines(cos_incidence, index_before, index_behind)
    pairs = _admittances(inner, outer, index_before, index_behind)
    return np.stack([_share(2.0 * np.sqrt(a * b), a + b) for a, b in pairs], axis=-1)


def _cosines(cos_incidence: Array, index_before: float, index_behind: float) -> tuple[Array, Array]:
    """Return the cosines of the angles on both sides; equal indices let all light through."""
    inner = np.asarray(cos_incidence, dtype=np.float64)
    wrong = ~((inner >= 0.0) & (inner <= 1.0))
    if wrong.any():
        raise InvalidParameter(
            f"cos_incidence has {inner[wrong].ravel()[0]}; a cosine of incidence is from 0 to 1",
            cos_incidence=float(inner[wrong].ravel()[0]),
        )
    for name, index in (("index_before", index_before), ("index_behind", index_behind)):
        if not 1.0 <= index < 10.0:
            raise InvalidParameter(f"{name} is {index}; it must be from 1 to 10", **{name: index})
    if index_before == index_behind:
        return np.ones_like(inner), np.ones_like(inner)
    square = 1.0 - (index_before / index_behind) ** 2 * (1.0 - inner) * (1.0 + inner)
    return inner, np.sqrt(np.maximum(square, 0.0))


def _admittances(
    inner: Array, outer: Array, before: float, behind: float
) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Return, for s and p, the admittances of the media on both sides."""
    return (before * inner, behind * outer), (behind * inner, before * outer)


def _share(amplitude: Array, total: Array) -> Array:
    # The total is zero only where all light is reflected.
    ratio = np.divide(amplitude, total, out=np.zeros_like(total), where=total > 0.0)
    return np.asarray(ratio**2)
