"""Chi-square of counted numbers against expected ones."""

import numpy as np
from numpy.typing import NDArray


def chi2_excess(observed: NDArray[np.int64], expected: NDArray[np.float64]) -> float:
    """Return chi2 less its mean, in its standard deviations; bins under 10 are pooled."""
    large = expected >= 10.0
    seen = np.append(observed[large], observed[~large].sum())
    due = np.append(expected[large], expected[~large].sum())
    seen, due = seen[due > 0.0], due[due > 0.0]
    freedom = max(len(seen) - 1, 1)
    return float((((seen - due) ** 2 / due).sum() - freedom) / np.sqrt(2 * freedom))
