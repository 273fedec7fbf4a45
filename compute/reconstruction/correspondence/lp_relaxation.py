"""Linear-programming relaxation of set packing, for clusters too large to enumerate."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import exp
from typing import Any, Final

Column = tuple[int, ...]

_COMPETING_SETS: Final = 10.0
"""Sets that may be as good as the best one without a column, of which one is bounded."""


@dataclass(frozen=True)
class PackingProblem:
    """Columns with scores that share resources.

    Args:
        columns: the resources that each uses.
        scores: of each.
        room: of resources that have more than one place.
    """

    columns: Sequence[Column]
    scores: Sequence[float]
    room: Mapping[int, int]


class LpRelaxation:
    """Maximum sum of scores, each resource used at most up to its capacity.

    SciPy's optimisers (HiGHS) are loaded here, where they are needed: small frames never do.

    Args:
        problem: columns, scores and capacities.
        cluster: the columns that may be taken.
    """

    def __init__(self, problem: PackingProblem, cluster: Sequence[int]) -> None:
        import numpy as np
        from scipy.sparse import csr_matrix

        columns, scores = problem.columns, problem.scores
        self.columns, self.scores, self.cluster = columns, scores, list(cluster)
        self.resources = sorted({r for index in cluster for r in columns[index]})
        row = {resource: at for at, resource in enumerate(self.resources)}
        rows = [row[r] for index in cluster for r in columns[index]]
        cols = [at for at, index in enumerate(cluster) for _ in columns[index]]
        shape = (len(self.resources), len(self.cluster))
        self.matrix: Any = csr_matrix((np.ones(len(rows)), (rows, cols)), shape=shape)
        self.limits = np.array([float(problem.room.get(r, 1)) for r in self.resources])
        self.cost = np.array([-scores[index] for index in cluster])

    def dual_prices(self) -> dict[int, float] | None:
        """Return dual prices that cover every column's score; None: the solver failed."""
        import numpy as np
        from scipy.optimize import linprog

        solution = linprog(self.cost, A_ub=self.matrix, b_ub=self.limits, method="highs-ds")
        if solution.status != 0:
            return None
        values = np.maximum(-solution.ineqlin.marginals, 0.0).tolist()
        prices = dict(zip(self.resources, values, strict=True))
        # Rounding may leave a column uncovered by a trifle; a bound has to be one.
        for index in self.cluster:
            missing = self.scores[index] - sum(prices[r] for r in self.columns[index])
            if missing > 0.0:
                prices[self.columns[index][0]] += missing
        return prices

    def error_probability_bounds(self, chosen: Sequence[int]) -> dict[int, float]:
        """Return upper bounds of the probabilities that columns of the best set are wrong.

        No set without it has a larger sum than the programme without it, taken in fractions.
        """
        import numpy as np
        from scipy.optimize import linprog

        score = sum(self.scores[index] for index in chosen)
        error_probability = {}
        for index in chosen:
            most = np.ones(len(self.cluster))
            most[self.cluster.index(index)] = 0.0
            bounds: Any = np.column_stack([np.zeros(len(most)), most])
            other: Any = linprog(
                self.cost, A_ub=self.matrix, b_ub=self.limits, bounds=bounds, method="highs-ds"
            )
            lost = score + float(other.fun) if other.status == 0 else 0.0
            error_probability[index] = min(_COMPETING_SETS * exp(-max(lost, 0.0)), 1.0)
        return error_probability
