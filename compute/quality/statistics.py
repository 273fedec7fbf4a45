"""ErrorStatistics: summary of errors in accuracy tests."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.errors import TooFewPoints

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ErrorStatistics:
    """Summary of N errors [mm], with the values that ASTM F2554 requires.

    Args:
        count: their number.
        mean: their mean.
        standard_deviation: about the mean, N - 1 degrees of freedom.
        rms: root of the mean square.
        percentile_95: below which 95 % of the magnitudes lie.
        largest: the largest magnitude.
    """

    count: int
    mean: float
    standard_deviation: float
    rms: float
    percentile_95: float
    largest: float


def error_statistics(errors_mm: Array) -> ErrorStatistics:
    """Summarise errors.

    Args:
        errors_mm: with their sign where they have one [mm], shape (N,).

    Raises:
        TooFewPoints: fewer than two.
    """
    if len(errors_mm) < 2:
        raise TooFewPoints(
            f"{len(errors_mm)} values were measured; at least 2 say how much they scatter",
            count=len(errors_mm),
        )
    magnitudes = np.abs(errors_mm)
    return ErrorStatistics(
        len(errors_mm),
        float(errors_mm.mean()),
        float(errors_mm.std(ddof=1)),
        float(np.sqrt((errors_mm**2).mean())),
        float(np.percentile(magnitudes, 95.0)),
        float(magnitudes.max()),
    )
