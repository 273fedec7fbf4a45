"""Packing: the likeliest set of markers that uses each peak once, and how sure each of them is."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from math import exp, inf
from typing import Final

_SWEEPS: Final = 6
_PROGRAMME: Final = 40  # columns from which on a linear programme tightens the bound
_HOPELESS: Final = 1e-9

Column = tuple[int, ...]


@dataclass(frozen=True)
class Packing:
    """A set of columns that do not share what only one of them may have.

    Args:
        chosen: indices of the columns of the likeliest set, ascending.
        wrong: chance that each chosen column is in no true set, in the same order.
        cut: clusters whose sets were not all weighed; their columns have a chance of 1.
    """

    chosen: tuple[int, ...]
    wrong: tuple[float, ...]
    cut: int


def pack(
    columns: Sequence[Column],
    scores: Sequence[float],
    window: float,
    most: int,
    capacity: Mapping[int, int] | None = None,
) -> Packing:
    """Choose columns with the largest sum of scores, and weigh all sets that come near.

    A set's weight is the exponential of its sum, a column's chance the weight of the sets without
    it over that of all. Columns that share nothing do not matter to each other, so clusters are
    taken apart. In each, prices y of the resources that no column's score exceeds bound every set
    (the dual of the linear programme): what a set loses against the bound is the sum of its
    columns' margins and of the prices of what it leaves unused. Columns whose margin alone is
    larger than the window and the best set's loss are in no set of interest; without them, most
    clusters fall apart again. The rest is enumerated, depth first: exact, as long as there are
    fewer than ``most`` branches.

    Args:
        columns: the resources (peaks) that each uses; none twice.
        scores: log likelihood ratio of each; those that are not positive are left out.
        window: sets whose score is lower than the best's by more are not weighed.
        most: branches of a cluster, at most.
        capacity: how many columns may share a resource, where it is more than one.
    """
    room = capacity or {}
    chosen: dict[int, float] = {}
    cut = 0
    useful = [index for index, score in enumerate(scores) if score > 0.0]
    for cluster in _clusters(columns, useful):
        if len(cluster) == 1:
            chosen[cluster[0]] = 1.0 / (1.0 + exp(min(scores[cluster[0]], 700.0)))
            continue
        prices = _prices(columns, scores, cluster, room)
        if len(cluster) >= _PROGRAMME:
            prices = _tighter(columns, scores, cluster, room, prices)
        first = _Search(columns, scores, cluster, prices, room, 0.0, most)
        first.run()
        if first.best == inf:
            first.best = sum(prices[r] * room.get(r, 1) for r in prices)
        reach = window + first.best
        margins = _margins(columns, scores, cluster, prices)
        near = [index for index in cluster if margins[index] <= reach]
        for part in _clusters(columns, near):
            search = _Search(columns, scores, part, prices, room, window, most)
            search.run()
            best, wrong = search.marginals()
            if search.cut or first.cut:
                cut += 1
                wrong = [1.0] * len(best)
            chosen.update(zip(best, wrong, strict=True))
    order = tuple(sorted(chosen))
    return Packing(order, tuple(chosen[index] for index in order), cut)


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
    found: dict[int, list[int]] = defaultdict(list)
    for index in use:
        found[root(columns[index][0])].append(index)
    return list(found.values())


def _margins(
    columns: Sequence[Column],
    scores: Sequence[float],
    cluster: Sequence[int],
    prices: Mapping[int, float],
) -> dict[int, float]:
    return {
        index: max(sum(prices[r] for r in columns[index]) - scores[index], 0.0)
        for index in cluster
    }


def _prices(
    columns: Sequence[Column],
    scores: Sequence[float],
    cluster: Sequence[int],
    room: Mapping[int, int],
) -> dict[int, float]:
    """Return prices that cover every column's score, lowered one by one."""
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
            if slack > _HOPELESS:
                prices[resource] -= slack
                lowered += slack
                for index in using[resource]:
                    cover[index] -= slack
        if lowered <= _HOPELESS:
            break
    return prices


def _tighter(
    columns: Sequence[Column],
    scores: Sequence[float],
    cluster: Sequence[int],
    room: Mapping[int, int],
    prices: dict[int, float],
) -> dict[int, float]:
    """Return the prices of the linear programme's dual; the ones given, if it has none."""
    # Loaded where it is needed: SciPy's optimisers take a while, and small frames never do.
    import numpy as np
    from scipy.optimize import linprog
    from scipy.sparse import csr_matrix

    resources = sorted(prices)
    row = {resource: index for index, resource in enumerate(resources)}
    rows = [row[r] for index in cluster for r in columns[index]]
    cols = [at for at, index in enumerate(cluster) for _ in columns[index]]
    matrix = csr_matrix(
        (np.ones(len(rows)), (rows, cols)), shape=(len(resources), len(cluster))
    )
    limits = [float(room.get(r, 1)) for r in resources]
    found = linprog(
        [-scores[index] for index in cluster], A_ub=matrix, b_ub=limits, method="highs-ds"
    )
    if found.status != 0:
        return prices
    tight = dict(zip(resources, np.maximum(-found.ineqlin.marginals, 0.0).tolist(), strict=True))
    # Rounding may leave a column uncovered by a trifle; a bound has to be one.
    for index in cluster:
        missing = scores[index] - sum(tight[r] for r in columns[index])
        if missing > 0.0:
            tight[columns[index][0]] += missing
    return tight


class _Search:
    """All sets of a cluster whose loss is within the window of the smallest."""

    def __init__(
        self,
        columns: Sequence[Column],
        scores: Sequence[float],
        cluster: Sequence[int],
        prices: Mapping[int, float],
        room: Mapping[int, int],
        window: float,
        most: int,
    ) -> None:
        self.columns, self.window, self.most = columns, window, most
        self.margins = _margins(columns, scores, cluster, prices)
        self.scores, self.room, self.prices = scores, room, prices
        self.using: dict[int, list[int]] = defaultdict(list)
        for index in sorted(cluster, key=lambda index: (self.margins[index], index)):
            for resource in columns[index]:
                self.using[resource].append(index)
        # First what is dear to leave and has few takers: wrong branches end early.
        self.order = sorted(
            self.using, key=lambda r: (-prices[r] / len(self.using[r]), r)
        )
        self.best = inf
        self.sets: list[tuple[float, tuple[int, ...]]] = []
        self.nodes = 0
        self.cut = False

    def run(self) -> None:
        self._grow(0, 0.0, (), {})

    def _grow(
        self, depth: int, loss: float, chosen: tuple[int, ...], used: dict[int, int]
    ) -> None:
        if loss > self.best + self.window + _HOPELESS or self.cut:
            return
        while depth < len(self.order) and used.get(self.order[depth], 0) >= self._room(depth):
            depth += 1
        if depth == len(self.order):
            self.best = min(self.best, loss)
            self.sets.append((loss, chosen))
            return
        self.nodes += 1
        if self.nodes > self.most:
            self.cut = True
            return
        resource = self.order[depth]
        free = self._room(depth) - used.get(resource, 0)
        takers = [
            index
            for index in self.using[resource]
            if index not in chosen and self._together((index,), used)
        ]
        options: list[tuple[float, tuple[int, ...]]] = [(free * self.prices[resource], ())]
        for count in range(1, min(free, len(takers)) + 1):
            left = (free - count) * self.prices[resource]
            for taken in combinations(takers, count):
                if count > 1 and not self._together(taken, used):
                    continue
                options.append((left + sum(self.margins[index] for index in taken), taken))
        options.sort()
        for extra, taken in options:
            if loss + extra > self.best + self.window + _HOPELESS:
                break
            after = dict(used)
            for index in taken:
                for r in self.columns[index]:
                    after[r] = after.get(r, 0) + 1
            # Decided: full, whatever it has room for.
            after[resource] = self._room(depth)
            self._grow(depth + 1, loss + extra, (*chosen, *taken), after)

    def _room(self, depth: int) -> int:
        return self.room.get(self.order[depth], 1)

    def _together(self, taken: tuple[int, ...], used: Mapping[int, int]) -> bool:
        count: dict[int, int] = defaultdict(int)
        for index in taken:
            for r in self.columns[index]:
                count[r] += 1
        return all(used.get(r, 0) + n <= self.room.get(r, 1) for r, n in count.items())

    def marginals(self) -> tuple[list[int], list[float]]:
        """Return the best set's columns and the chance that each is not in the true one."""
        if not self.sets:
            return [], []
        # Of sets that are equal to rounding, the first in order: the same on every machine.
        _, best = min(self.sets, key=lambda one: (round(one[0] - self.best, 6), sorted(one[1])))
        total, without = 0.0, dict.fromkeys(best, 0.0)
        for loss, chosen in self.sets:
            if loss > self.best + self.window + _HOPELESS:
                continue
            weight = exp(self.best - loss)
            total += weight
            for index in best:
                if index not in chosen:
                    without[index] += weight
        kept = sorted(best)
        return kept, [without[index] / total for index in kept]
