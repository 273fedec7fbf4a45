"""Distortion as a polynomial in both field angles: terms, values and derivatives.

A point at x, y, z in a sensor's frame is read at ``p = p0 + c (u + d(u, v))`` with the field
angles ``u = x/z`` along the row and ``v = y/(z + d)`` along the lens's axis, and
``d(u, v) = sum a_ij u^i v^j``; the light that is read goes to the row, the distance d behind the
lens, and not to the lens's centre. With u alone it is the thesis's ([3.4], [3.21], Tables 3.1 and
3.2); v comes in by the skew effect, see ``skew_rays``.

Five terms are degenerate: a camera's own parameters have the same effect, at least to first
order, and a fit of both has no single solution. They are in DEGENERATE.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter

Array = NDArray[np.float64]
Term = tuple[int, int]
"""Powers i, j of u^i v^j."""

DEGENERATE: Final[dict[Term, str]] = {
    (0, 0): "the principal point",
    (1, 0): "the principal distance",
    (0, 1): "roll, a rotation about the optical axis",
    (2, 0): "pan, a rotation about the lens's axis, with the principal point",
    (1, 1): "tilt, a rotation about the row",
}
"""Terms that are degenerate with a camera's own parameters, and which."""


@dataclass(frozen=True)
class FieldDistortion:
    """A lens's contribution to the field angle u that is read, ``sum a_ij u^i v^j``.

    Args:
        terms: powers (i, j); none of those in DEGENERATE.
        coefficients: a_ij, in the order of the terms.
        offset_y_mm: y of the world's origin in the sensor's frame, along the slit [mm]. Without
            distortion no reading depends on it; v does.
        row_behind_mm: distance of the pixel row behind the lens, its glass taken as air, about the
            principal distance [mm]; known, not fitted. 0 where unknown: v is then taken to the
            lens's centre, which costs some hundredths of a pixel in a wide field.

    Raises:
        InvalidParameter: terms that are refused by ``check_terms``, or not one coefficient each.
    """

    terms: tuple[Term, ...]
    coefficients: tuple[float, ...]
    offset_y_mm: float = 0.0
    row_behind_mm: float = 0.0

    def __post_init__(self) -> None:
        check_terms(self.terms)
        if len(self.coefficients) != len(self.terms):
            raise InvalidParameter(
                f"{len(self.coefficients)} coefficients for {len(self.terms)} terms; give one each",
                coefficients=len(self.coefficients),
            )


def power_terms(order: int, *, odd_only: bool) -> tuple[Term, ...]:
    """Return the terms in u alone, from u^3 to a power.

    Args:
        order: the highest power.
        odd_only: odd powers only.
    """
    return tuple((i, 0) for i in range(3, order + 1, 2 if odd_only else 1))


def symmetric_terms(order: int) -> tuple[Term, ...]:
    """Return the terms of a centred lens: i odd, j even, i + j at most ``order``."""
    return tuple((i, j) for i, j in all_terms(order) if i % 2 == 1 and j % 2 == 0)


def all_terms(order: int) -> tuple[Term, ...]:
    """Return all terms with i + j at most ``order`` that are not in DEGENERATE."""
    return tuple(
        (i, j) for i in range(order + 1) for j in range(order - i + 1) if (i, j) not in DEGENERATE
    )


def check_terms(terms: Sequence[Term]) -> None:
    """Check that terms are not degenerate with the camera, negative, or repeated.

    Raises:
        InvalidParameter: such a term.
    """
    for number, term in enumerate(terms):
        if term in DEGENERATE:
            raise InvalidParameter(
                f"terms has u^{term[0]} v^{term[1]}, which is degenerate with "
                f"{DEGENERATE[term]}; leave it out",
                terms=term,
            )
        if min(term) < 0 or term in terms[:number]:
            raise InvalidParameter(
                f"terms has {term} at index {number}; powers must be 0 or more, each pair once",
                terms=term,
            )


def term_values(u: Array, v: Array, terms: Sequence[Term]) -> Array:
    """Return u^i v^j for each term, shape (..., K).

    Args:
        u: field angle along the row, shape (...).
        v: field angle along the slit, shape (...).
        terms: K powers (i, j).
    """
    powers_u, powers_v = (_powers(x, terms, axis) for axis, x in enumerate((u, v)))
    values = np.empty((*np.shape(u), len(terms)))
    for index, (i, j) in enumerate(terms):
        np.multiply(powers_u[i], powers_v[j], out=values[..., index])
    return values


def term_derivatives(u: Array, v: Array, terms: Sequence[Term]) -> tuple[Array, Array]:
    """Return the derivatives of u^i v^j by u and by v, both of shape (..., K).

    Args:
        u: field angle along the row, shape (...).
        v: field angle along the slit, shape (...).
        terms: K powers (i, j).
    """
    powers_u, powers_v = (_powers(x, terms, axis) for axis, x in enumerate((u, v)))
    by_u, by_v = np.empty((2, *np.shape(u), len(terms)))
    for index, (i, j) in enumerate(terms):
        np.multiply(i * powers_u[max(i - 1, 0)], powers_v[j], out=by_u[..., index])
        np.multiply(powers_u[i], j * powers_v[max(j - 1, 0)], out=by_v[..., index])
    return by_u, by_v


def distortion(u: Array, v: Array, terms: Sequence[Term], coefficients: Array) -> Array:
    """Return d(u, v), shape (...).

    Args:
        u: field angle along the row, shape (...).
        v: field angle along the slit, shape (...).
        terms: K powers (i, j).
        coefficients: a_ij, shape (K,).
    """
    values: Array = term_values(u, v, terms) @ coefficients
    return values


def _powers(values: Array, terms: Sequence[Term], axis: int) -> list[Array]:
    """Return x^0, x^1, .. up to the highest power of the terms; faster than ``**``."""
    powers = [np.ones(np.shape(values))]
    for _ in range(max((term[axis] for term in terms), default=0)):
        powers.append(powers[-1] * values)
    return powers
