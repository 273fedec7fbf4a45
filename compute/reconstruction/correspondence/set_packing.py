"""Set packing: the most probable set of candidates that uses each peak once."""

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from math import exp
from typing import Final

from compute.reconstruction.correspondence.lp_relaxation import Column, LpRelaxation, PackingProblem

_SWEEPS: Final = 6
_LP_MIN_COLUMNS: Final = 40  # columns from which on a linear programme tightens the bound
_PRICE_TOLERANCE: Final = 1e-9
_LOSS_TIE_TOLERANCE: Final = 1e-6
_FIRST_BUDGET: Final = 4.0


@dataclass(frozen=True)
class SetPacking:
    """Set of columns that respects the capacity of every resource.

    Args:
        chosen: indices of the columns of the most probable set, ascending.
        error_probability: probability that each chosen column is in no true set, in the same order.
        cut: clusters whose sets were not all weighed; their columns have the probability 1.
    """

    chosen: tuple[int, ...]
    error_probability: tuple[float, ...]
    cut: int


def solve_set_packing(
    columns: Sequence[Column],
    scores: Sequence[float],
    window: float,
    max_branches: int,
    capacity: Mapping[int, int] | None = None,
) -> SetPacking:
    """Choose the columns with the largest sum of scores, and weigh all sets near the maximum.

    A set's weight is the exponential of its sum, a column's error probability the weight of the
    sets without it over that of all. Columns that share nothing do not matter to each other, so
    clusters are taken apart. In each, prices y of the resources that no column's score exceeds
    bound every set (the dual of the linear programme): what a set loses against the bound is the
    sum of its columns' margins and of the prices of what it leaves unused. Columns whose margin
    alone is larger than the window and the best set's loss are in no set of interest; without them,
    most clusters fall apart again. The rest is enumerated, depth first: exact, but for sets outside
    the window, as long as there are at most ``max_branches`` branches. If it takes more to weigh
    what is near the best set, the linear programme without each of its columns bounds what those
    sets weigh. If it takes more to find the best set, columns are taken by their scores and none is
    sure.

    Args:
        columns: the resources (peaks) that each uses; none twice.
        scores: log likelihood ratio of each; those that are not positive are left out.
        window: sets whose score is lower than the best's by more are not weighed.
        max_branches: branches of a cluster, at most.
        capacity: how many columns may share a resource, where it is more than one.
    """
    room = capacity or {}
    problem = PackingProblem(columns, scores, room)
    chosen: dict[int, float] = {}
    cut = 0
    useful = [index for index, score in enumerate(scores) if score > 0.0]
    for cluster in _clusters(columns, useful):
        if len(cluster) == 1:
            chosen[cluster[0]] = 1.0 / (1.0 + exp(min(scores[cluster[0]], 700.0)))
            continue
        prices = _prices(problem, cluster)
        if len(cluster) >= _LP_MIN_COLUMNS:
            prices = LpRelaxation(problem, cluster).dual_prices() or prices
        greedy = _greedy(problem, cluster)
        bound = sum(price * room.get(resource, 1) for resource, price in prices.items())
        reach = window + bound - sum(scores[index] for index in greedy)
        margins = {
            index: max(sum(prices[r] for r in columns[index]) - scores[index], 0.0)
            for index in cluster
        }
        near = [index for index in cluster if margins[index] <= reach + _PRICE_TOLERANCE]
        for part in _clusters(columns, near):
            search = _Search(problem, prices, margins, max_branches)
            near_best, complete = search.enumerate_near_best(part, window)
            if near_best is None:
                cut += 1
                inside = set(part)
                chosen.update((index, 1.0) for index in greedy if index in inside)
            elif complete:
                chosen.update(
                    (index, max(1.0 - near_best.probability[index], 0.0))
                    for index in near_best.best
                )
            else:
                chosen.update(LpRelaxation(problem, part).error_probability_bounds(near_best.best))
    order = tuple(sorted(chosen))
    return SetPacking(order, tuple(chosen[index] for index in order), cut)


def _greedy(problem: PackingProblem, cluster: Sequence[int]) -> list[int]:
    """Return columns by falling score, as long as there is room for them."""
    columns, scores, room = problem.columns, problem.scores, problem.room
    used: dict[int, int] = defaultdict(int)
    selected = []
    for index in sorted(cluster, key=lambda index: (-scores[index], index)):
        if all(used[r] < room.get(r, 1) for r in columns[index]):
            selected.append(index)
            for r in columns[index]:
                used[r] += 1
    return selected


def _clusters(columns: Sequence[Column], use: Sequence[int]) -> list[list[int]]:
    """Return the columns that are linked by shared resources, each list ascending."""
    parent: dict[int, int] = {}

    def root(node: int) -> int:
        while parent[node] != node:
            parent[node] = parent[parent[node]]
            node = parent[node]
        return node

    for index in use:
        head, *others = columns[index]
        parent.setdefault(head, head)
        for other in others:
            parent.setdefault(other, other)
            parent[root(other)] = root(head)
    clusters: dict[int, list[int]] = defaultdict(list)
    for index in use:
        clusters[root(columns[index][0])].append(index)
    return list(clusters.values())


def _prices(problem: PackingProblem, cluster: Sequence[int]) -> dict[int, float]:
    """Return prices that cover every column's score, lowered one by one."""
    columns, scores, room = problem.columns, problem.scores, problem.room
    using: dict[int, list[int]] = defaultdict(list)
    for index in cluster:
        for resource in columns[index]:
            using[resource].append(index)
    prices = {
        resource: max(scores[index] / len(columns[index]) for index in users)
        for resource, users in using.items()
    }
    cover = {index: sum(prices[r] for r in columns[index]) for index in cluster}
    # What many want and few may have is lowered last.
    order = sorted(prices, key=lambda r: (len(using[r]) / room.get(r, 1), r))
    for _ in range(_SWEEPS):
        lowered = 0.0
        for resource in order:
            slack = min(cover[index] - scores[index] for index in using[resource])
            slack = min(slack, prices[resource])
            if slack > _PRICE_TOLERANCE:
                prices[resource] -= slack
                lowered += slack
                for index in using[resource]:
                    cover[index] -= slack
        if lowered <= _PRICE_TOLERANCE:
            break
    return prices


@dataclass(frozen=True)
class _WeightedSets:
    """Sets of a part: sum of weights, smallest loss, its columns, each column's probability."""

    weight: float
    loss: float
    best: tuple[int, ...]
    probability: dict[int, float]


class _Search:
    """All sets of a cluster whose loss is within a budget, part by part as it falls apart.

    A resource is decided at a time: left as it is, or used by one of its columns (or two, where
    it has room). What is left falls into parts that do not matter to each other, so that their
    weights multiply and no set has to be written down. Resources are bits of whole numbers.
    """

    def __init__(
        self,
        problem: PackingProblem,
        prices: Mapping[int, float],
        margins: Mapping[int, float],
        max_branches: int,
    ) -> None:
        bit = {resource: 1 << at for at, resource in enumerate(sorted(prices))}
        self.mask = {index: sum(bit[r] for r in problem.columns[index]) for index in margins}
        self.price = {bit[r]: price for r, price in prices.items()}
        self.double = sum(bit[r] for r in prices if problem.room.get(r, 1) > 1)
        self.margins, self.max_branches = margins, max_branches
        self.memo: dict[tuple[tuple[int, ...], int], tuple[float, _WeightedSets | None]] = {}
        self.nodes = 0
        self.cut = False

    def enumerate_near_best(
        self, cluster: Sequence[int], window: float
    ) -> tuple[_WeightedSets | None, bool]:
        """Return the sets near the best, and whether they are all that are within the window.

        None if there are too many branches even to find the best.
        """
        budget = _FIRST_BUDGET
        best = self._branch(tuple(cluster), 0, budget)
        while best is None and not self.cut:
            budget += _FIRST_BUDGET
            best = self._branch(tuple(cluster), 0, budget)
        if best is None or budget >= best.loss + window:
            return best, True
        # As many branches again: the best is known, what comes near it may be bounded.
        self.nodes = 0
        near = self._branch(tuple(cluster), 0, best.loss + window)
        return (best, False) if near is None else (near, True)

    def _branch(self, cluster: tuple[int, ...], once: int, budget: float) -> _WeightedSets | None:
        """Weigh the sets of a part; ``once`` are the double resources that are used once."""
        covered = 0
        for index in cluster:
            covered |= self.mask[index]
        key = (cluster, once & covered)
        cached = self.memo.get(key)
        if cached is not None and cached[0] >= budget:
            return cached[1]
        self.nodes += 1
        if self.nodes > self.max_branches:
            self.cut = True
            return None
        resource, options = self._branch_options(cluster, covered, once, budget)
        alternatives: list[_WeightedSets] = []
        for extra, selected in options:
            one = self._fix_resource(cluster, covered, once, resource, extra, selected, budget)
            if self.cut:
                return None
            if one is not None:
                alternatives.append(one)
        result = _sum_alternatives(alternatives)
        self.memo[key] = (budget, result)
        return result

    def _branch_options(
        self, cluster: tuple[int, ...], covered: int, once: int, budget: float
    ) -> tuple[int, list[tuple[float, tuple[int, ...]]]]:
        """Return the resource with the fewest ways to go, and those with what each loses."""
        takers: dict[int, list[int]] = {bit: [] for bit in _bits(covered)}
        for index in cluster:
            for bit in _bits(self.mask[index]):
                takers[bit].append(index)

        def ways(bit: int) -> tuple[int, float, int]:
            price = self.price[bit]
            return len(takers[bit]) + (price <= budget), -price, bit

        resource = min(takers, key=ways)
        price, users = self.price[resource], takers[resource]
        free = 2 if resource & self.double & ~once else 1
        options: list[tuple[float, tuple[int, ...]]] = [(free * price, ())]
        options += [((free - 1) * price + self.margins[index], (index,)) for index in users]
        if free > 1:
            for one, other in combinations(users, 2):
                # Together only where every resource that both want has room for two.
                both = self.mask[one] & self.mask[other]
                if not both & ~self.double and not both & once:
                    options.append((self.margins[one] + self.margins[other], (one, other)))
        options.sort()
        return resource, [option for option in options if option[0] <= budget]

    def _fix_resource(
        self,
        cluster: tuple[int, ...],
        covered: int,
        once: int,
        resource: int,
        loss: float,
        selected: tuple[int, ...],
        budget: float,
    ) -> _WeightedSets | None:
        """Weigh the sets of the remaining columns after a resource has been decided."""
        # Decided: full, whatever it has room for.
        full = resource
        for index in selected:
            mask = self.mask[index]
            full |= mask & (once | ~self.double)
            once |= mask & self.double
        parts: list[tuple[int, list[int]]] = []
        still = 0
        for index in cluster:
            mask = self.mask[index]
            if mask & full or self.margins[index] > budget - loss:
                continue
            still |= mask
            joined, members = mask, [index]
            apart = []
            for part in parts:
                if part[0] & mask:
                    joined |= part[0]
                    members = part[1] + members
                else:
                    apart.append(part)
            parts = [*apart, (joined, members)]
        for bit in _bits(covered & ~still & ~full):
            loss += self.price[bit] * (2 if bit & self.double & ~once else 1)
        if loss > budget:
            return None
        weight, best, probability = exp(-loss), selected, dict.fromkeys(selected, 1.0)
        for _, members in parts:
            some = self._branch(tuple(sorted(members)), once, budget - loss)
            if some is None:
                return None
            weight *= some.weight
            loss += some.loss
            best += some.best
            probability.update(some.probability)
        return _WeightedSets(weight, loss, best, probability)


def _bits(mask: int) -> Iterator[int]:
    """Yield the bits of a number that are set, the lowest first."""
    while mask:
        yield mask & -mask
        mask &= mask - 1


def _sum_alternatives(alternatives: Sequence[_WeightedSets]) -> _WeightedSets | None:
    """Return alternatives as one."""
    if not alternatives:
        return None
    weight = sum(one.weight for one in alternatives)
    if weight <= 0.0:
        return None
    # Of sets that are equal to rounding, the first in order: the same on every machine.
    least = min(one.loss for one in alternatives)
    best = min(
        (one for one in alternatives if one.loss <= least + _LOSS_TIE_TOLERANCE),
        key=lambda one: sorted(one.best),
    )
    probability: dict[int, float] = defaultdict(float)
    for one in alternatives:
        share = one.weight / weight
        for index, value in one.probability.items():
            probability[index] += share * value
    return _WeightedSets(weight, least, best.best, dict(probability))
