"""Correspondence errors of a registration: exchanged or misplaced fiducials."""

from dataclasses import dataclass, replace
from functools import cached_property
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
    """Hypotheses of one kind: orders (E, N), the pairs that each uses, and their misfits."""

    order: NDArray[np.intp]
    pairs: NDArray[np.intp]
    squares: Array

    @property
    def best(self) -> int:
        return int(np.argmin(self.squares))

    @property
    def min_square(self) -> float:
        return float(self.squares[self.best])

    @property
    def dof(self) -> int:
        return 3 * int(self.pairs.shape[1]) - 6


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
    pairs = _Pairs(source, target, variance_mm2)
    orders = pairs.orders()
    return pairs.find_errors(orders), pairs.symmetric_orders(orders)


@dataclass(frozen=True, eq=False)
class _Pairs:
    """The pairs of a registration."""

    source: Array
    target: Array
    variance: Array | None

    @cached_property
    def original(self) -> _Hypotheses:
        return self.squares(np.arange(len(self.source))[None])

    def find_errors(self, orders: list[_Hypotheses]) -> CorrespondenceErrors | None:
        sigma_known = self.variance is not None
        if (
            sigma_known
            and chi_square.sf(self.original.squares[0], self.original.dof) > SIGNIFICANCE
        ):
            return None
        # Exclusions come last: an exchange that explains the misfit needs no wrong point.
        tried = [*orders, *self.exclusions()]
        count = sum(len(one.squares) for one in tried)
        least, least_dof = min((one.min_square / one.dof, one.dof) for one in tried)
        for one in tried:
            p_value = count * _p_value(self.original, one, sigma_known)
            # A hypothesis with a clearly larger misfit than another one is not the explanation.
            if sigma_known:
                as_good = chi_square.sf(one.min_square, one.dof) > SIGNIFICANCE
            else:
                limit = max(least, 1e-300) * fisher.isf(0.01, one.dof, least_dof)
                as_good = one.min_square / one.dof <= limit
            if p_value < SIGNIFICANCE and as_good:
                return self.describe(one, min(float(p_value), 1.0))
        return None

    def symmetric_orders(self, orders: list[_Hypotheses]) -> tuple[tuple[int, ...], ...]:
        dof = self.original.dof
        if self.variance is None:
            bound = max(self.original.squares[0], 1e-18) * fisher.isf(
                SYMMETRY_PROBABILITY, dof, dof
            )
        else:
            bound = chi_square.isf(SYMMETRY_PROBABILITY, dof)
        symmetric = [
            (float(tried.squares[one]), tuple(tried.order[one].tolist()))
            for tried in orders
            for one in np.flatnonzero(tried.squares <= bound)
        ]
        return tuple(order for _, order in sorted(symmetric))

    def orders(self) -> list[_Hypotheses]:
        """Return the other orders of the targets, by the number of pairs that they change."""
        count = len(self.source)
        rows: dict[int, list[list[int]]] = {}
        if count <= _MAX_EXHAUSTIVE_PAIRS:
            for order in permutations(range(count)):
                moved = sum(one != goal for one, goal in enumerate(order))
                rows.setdefault(moved, []).append([*order])
            rows.pop(0)
        else:
            worst = self.worst()
            rows[2] = [_cycle(count, two) for two in combinations(sorted(worst), 2)]
            rows[3] = [
                _cycle(count, ring)
                for a, b, c in combinations(sorted(worst[:_MAX_CYCLE_PAIRS]), 3)
                for ring in ((a, b, c), (a, c, b))
            ]
        return [self.squares(np.array(rows[moved], np.intp)) for moved in sorted(rows)]

    def exclusions(self) -> list[_Hypotheses]:
        count = len(self.source)
        every, hypotheses = np.arange(count), []
        for left_out in (1, 2):
            # Fewer than four pairs, or three degrees of freedom, fit by chance.
            if 3 * (count - left_out) - 6 < _MIN_DOF + 3 * (left_out - 1):
                continue
            out = combinations(sorted(self.worst()), left_out)
            pairs = np.array([np.setdiff1d(every, one) for one in out])
            hypotheses.append(self.squares(np.broadcast_to(every, (len(pairs), count)), pairs))
        return hypotheses

    def worst(self) -> list[int]:
        """Return the pairs with the largest residuals, largest first."""
        weights = np.ones(len(self.source)) if self.variance is None else 1.0 / self.variance
        fitted = fit_isotropic_similarity(self.source, self.target, weights)
        off = np.linalg.norm(fitted.apply(self.source) - self.target, axis=1) * np.sqrt(weights)
        worst: list[int] = np.argsort(-off)[:_MAX_SWAP_PAIRS].tolist()
        return worst

    def squares(
        self, order: NDArray[np.intp], pairs: NDArray[np.intp] | None = None
    ) -> _Hypotheses:
        """Return the least sum of weighted squares of each of E orders over rigid transforms."""
        rows = np.broadcast_to(np.arange(order.shape[1]), order.shape) if pairs is None else pairs
        x, y = self.source[rows], self.target[np.take_along_axis(order, rows, axis=1)]
        weights = np.ones(rows.shape) if self.variance is None else 1.0 / self.variance[rows]
        share = weights / weights.sum(axis=1, keepdims=True)
        x = x - np.einsum("en,eni->ei", share, x)[:, None]
        y = y - np.einsum("en,eni->ei", share, y)[:, None]
        cross_covariance = np.einsum("en,eni,enj->eij", weights, y, x)
        a, b, c = np.linalg.svd(cross_covariance, compute_uv=False).T
        turned = a + b + np.sign(np.linalg.det(cross_covariance)) * c
        total = np.einsum("en,eni->e", weights, x**2 + y**2)
        return _Hypotheses(order, rows, np.maximum(total - 2.0 * turned, 0.0))

    def describe(self, tried: _Hypotheses, p_value: float) -> CorrespondenceErrors:
        order, pairs = tried.order[tried.best], tried.pairs[tried.best]
        every = np.arange(len(order))
        moved = np.flatnonzero(order != every)
        wrong = moved if len(moved) else np.setdiff1d(every, pairs)
        unweighted = replace(self, variance=None)
        before = unweighted.original.squares[0] / len(every)
        after = unweighted.squares(order[None], pairs[None]).squares[0] / len(pairs)
        return CorrespondenceErrors(
            "exchanged" if len(moved) else "misplaced",
            tuple(wrong.tolist()),
            tuple(order.tolist()),
            float(np.sqrt(before)),
            float(np.sqrt(after)),
            p_value,
        )


def _p_value(original: _Hypotheses, tried: _Hypotheses, sigma_known: bool) -> float:
    """Return the probability that noise makes the given order this much worse."""
    before, after = float(original.squares[0]), tried.min_square
    fewer = original.dof - tried.dof
    if sigma_known:
        return float(chi_square.sf(before - after, fewer or original.dof))
    after = max(after, 1e-18)
    if fewer:
        ratio = (before - after) / fewer / (after / tried.dof)
        return float(fisher.sf(ratio, fewer, tried.dof))
    return float(fisher.sf(before / after, original.dof, tried.dof))


def _cycle(count: int, ring: tuple[int, ...]) -> list[int]:
    order = list(range(count))
    for here, there in zip(ring, (*ring[1:], ring[0]), strict=True):
        order[here] = there
    return order
