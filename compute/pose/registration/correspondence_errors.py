"""Correspondence errors of a registration: exchanged or misplaced fiducials."""

from dataclasses import dataclass
from itertools import combinations, permutations
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2 as chi_square
from scipy.stats import f as fisher

from compute.pose.registration.absolute_orientation import fit_isotropic_similarity

Array = NDArray[np.float64]

SIGNIFICANCE: Final = 1e-3
"""Probability that noise alone causes a finding, over all hypotheses that are tested."""
SYMMETRY_PROBABILITY: Final = 0.01
"""Another order fits as well where noise explains the difference with a higher probability."""
_MAX_EXHAUSTIVE_PAIRS: Final = 6
_MAX_CYCLE_PAIRS: Final = 20
_MAX_SWAP_PAIRS: Final = 60
_MIN_DOF: Final = 3


@dataclass(frozen=True)
class CorrespondenceErrors:
    """The correspondence errors of a registration, and the residual without them.

    Args:
        kind: ``exchanged``: the targets fit in another order; ``misplaced``: the pairs fit in no
            order, and the others agree without them.
        pairs: indices of the wrong pairs.
        order: index of the matching target of each source.
        rms_before_mm: RMS residual as given [mm].
        rms_after_mm: RMS residual of the remaining pairs after the correction [mm].
        p_value: probability that noise alone makes the same difference, over all hypotheses.
    """

    kind: Literal["exchanged", "misplaced"]
    pairs: tuple[int, ...]
    order: tuple[int, ...]
    rms_before_mm: float
    rms_after_mm: float
    p_value: float


@dataclass(frozen=True, eq=False)
class _Hypotheses:
    """Hypotheses of one kind: orders (E, N), the pairs that each keeps, and their misfits."""

    order: NDArray[np.intp]
    kept: NDArray[np.intp]
    squares: Array

    @property
    def best(self) -> int:
        return int(np.argmin(self.squares))

    @property
    def dof(self) -> int:
        return 3 * int(self.kept.shape[1]) - 6


def find_correspondence_errors(
    source: Array, target: Array, variance_mm2: Array | None = None
) -> tuple[CorrespondenceErrors | None, tuple[tuple[int, ...], ...]]:
    """Return the correspondence errors, and other orders that fit as well.

    Tests all orders of up to six pairs; of more, all exchanges of two and cycles of three (among up
    to 60 and 20 pairs with the largest residuals); and the exclusion of one or two pairs. A
    hypothesis must beat the given order significantly (``SIGNIFICANCE`` over all that are tested);
    of those that do, the one that keeps most pairs is chosen.

    Args:
        source: shape (N, 3) [mm].
        target: shape (N, 3) [mm].
        variance_mm2: variance of a coordinate of each pair, both sides together, shape (N,)
            [mm^2]; None: unknown, and equal for all.

    Returns:
        The errors, None where there are none; and the orders of the targets that fit about as
        well as the given one, best first: an exchange to one of these does not show in the
        residuals.
    """
    orders = _orders(source, target, variance_mm2)
    return (
        _find_errors(source, target, variance_mm2, orders),
        _symmetric_orders(source, target, variance_mm2, orders),
    )


def _find_errors(
    source: Array, target: Array, variance_mm2: Array | None, orders: list[_Hypotheses]
) -> CorrespondenceErrors | None:
    given = _squares(source, target, np.arange(len(source))[None], variance_mm2)
    dof = 3 * len(source) - 6
    if variance_mm2 is not None and chi_square.sf(given.squares[0], dof) > SIGNIFICANCE:
        return None
    # Exclusions come last: an exchange that explains the misfit needs no wrong point.
    tried = [*orders, *_exclusions(source, target, variance_mm2)]
    count = sum(len(one.squares) for one in tried)
    least = min((float(one.squares[one.best]) / one.dof, one.dof) for one in tried)
    for one in tried:
        p_value = count * _p_value(given, one, variance_mm2 is not None)
        mean = one.squares[one.best] / one.dof
        # A hypothesis with a clearly larger misfit than another one is not the explanation.
        as_good = mean <= max(least[0], 1e-300) * fisher.isf(0.01, one.dof, least[1])
        if variance_mm2 is not None:
            as_good = chi_square.sf(one.squares[one.best], one.dof) > SIGNIFICANCE
        if p_value < SIGNIFICANCE and as_good:
            return _describe(source, target, one, min(float(p_value), 1.0))
    return None


def _symmetric_orders(
    source: Array, target: Array, variance_mm2: Array | None, orders: list[_Hypotheses]
) -> tuple[tuple[int, ...], ...]:
    given = _squares(source, target, np.arange(len(source))[None], variance_mm2)
    dof = given.dof
    if variance_mm2 is None:
        bound = max(given.squares[0], 1e-18) * fisher.isf(SYMMETRY_PROBABILITY, dof, dof)
    else:
        bound = chi_square.isf(SYMMETRY_PROBABILITY, dof)
    found = []
    for tried in orders:
        near = np.flatnonzero(tried.squares <= bound)
        found += [(float(tried.squares[one]), tuple(tried.order[one].tolist())) for one in near]
    return tuple(order for _, order in sorted(found))


def _p_value(given: _Hypotheses, tried: _Hypotheses, known: bool) -> float:
    """Return the probability that noise makes the given order this much worse."""
    before, after = float(given.squares[0]), float(tried.squares[tried.best])
    fewer = given.dof - tried.dof
    if known:
        return float(chi_square.sf(before - after, fewer or given.dof))
    after = max(after, 1e-18)
    if fewer:
        ratio = (before - after) / fewer / (after / tried.dof)
        return float(fisher.sf(ratio, fewer, tried.dof))
    return float(fisher.sf(before / after, given.dof, tried.dof))


def _orders(source: Array, target: Array, variance: Array | None) -> list[_Hypotheses]:
    count = len(source)
    rows: dict[int, list[list[int]]] = {}
    if count <= _MAX_EXHAUSTIVE_PAIRS:
        for order in permutations(range(count)):
            rows.setdefault(int((np.array(order) != np.arange(count)).sum()), []).append([*order])
        rows.pop(0)
    else:
        off = _residuals(source, target, variance)
        worst = np.argsort(-off)
        for two in combinations(sorted(worst[:_MAX_SWAP_PAIRS].tolist()), 2):
            rows.setdefault(2, []).append(_cycle(count, two))
        for a, b, c in combinations(sorted(worst[:_MAX_CYCLE_PAIRS].tolist()), 3):
            rows.setdefault(3, []).extend([_cycle(count, (a, b, c)), _cycle(count, (a, c, b))])
    return [
        _squares(source, target, np.array(rows[moved], np.intp), variance) for moved in sorted(rows)
    ]


def _cycle(count: int, ring: tuple[int, ...]) -> list[int]:
    order = list(range(count))
    for here, there in zip(ring, (*ring[1:], ring[0]), strict=True):
        order[here] = there
    return order


def _exclusions(source: Array, target: Array, variance: Array | None) -> list[_Hypotheses]:
    count = len(source)
    found = []
    for left_out in (1, 2):
        # Fewer than four pairs, or three degrees of freedom, fit by chance.
        if 3 * (count - left_out) - 6 < _MIN_DOF + 3 * (left_out - 1):
            continue
        worst = sorted(np.argsort(-_residuals(source, target, variance))[:_MAX_SWAP_PAIRS].tolist())
        kept = np.array(
            [np.setdiff1d(np.arange(count), out) for out in combinations(worst, left_out)]
        )
        same = np.broadcast_to(np.arange(count), (len(kept), count))
        found.append(_squares(source, target, same, variance, kept))
    return found


def _residuals(source: Array, target: Array, variance: Array | None) -> Array:
    weights = np.ones(len(source)) if variance is None else 1.0 / variance
    off = fit_isotropic_similarity(source, target, weights).apply(source) - target
    sizes: Array = np.linalg.norm(off, axis=1) * np.sqrt(weights)
    return sizes


def _squares(
    source: Array,
    target: Array,
    order: NDArray[np.intp],
    variance: Array | None,
    kept: NDArray[np.intp] | None = None,
) -> _Hypotheses:
    """Return the least sum of weighted squares of each of E orders over all rigid transforms."""
    rows = np.broadcast_to(np.arange(order.shape[1]), order.shape) if kept is None else kept
    goals = np.take_along_axis(order, rows, axis=1)
    x, y = source[rows], target[goals]
    weights = np.ones(rows.shape) if variance is None else 1.0 / variance[rows]
    share = weights / weights.sum(axis=1, keepdims=True)
    x = x - np.einsum("en,eni->ei", share, x)[:, None]
    y = y - np.einsum("en,eni->ei", share, y)[:, None]
    cross_covariance = np.einsum("en,eni,enj->eij", weights, y, x)
    values = np.linalg.svd(cross_covariance, compute_uv=False)
    turned = values[:, 0] + values[:, 1] + np.sign(np.linalg.det(cross_covariance)) * values[:, 2]
    total = np.einsum("en,eni->e", weights, x**2 + y**2)
    return _Hypotheses(order, rows, np.maximum(total - 2.0 * turned, 0.0))


def _describe(
    source: Array, target: Array, tried: _Hypotheses, p_value: float
) -> CorrespondenceErrors:
    order, kept = tried.order[tried.best], tried.kept[tried.best]
    every = np.arange(len(order))
    moved = np.flatnonzero(order != every)
    wrong = moved if len(moved) else np.setdiff1d(every, kept)
    before = _squares(source, target, every[None], None).squares[0] / len(every)
    after = _squares(source, target, order[None], None, kept[None]).squares[0] / len(kept)
    return CorrespondenceErrors(
        "exchanged" if len(moved) else "misplaced",
        tuple(wrong.tolist()),
        tuple(order.tolist()),
        float(np.sqrt(before)),
        float(np.sqrt(after)),
        p_value,
    )
