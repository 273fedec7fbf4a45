"""average_scans: the mean of neighbouring lines, thesis 3.6 and 4.4 (Figure 4.11a)."""

import numpy as np
from numpy.typing import ArrayLike

from compute.errors import InvalidParameter
from compute.signal.thesis_pipeline.steps import Array, as_lines, check_whole


def average_scans(lines: ArrayLike, count: int) -> Array:
    """Average every ``count`` lines that follow one another; the pixels' noise falls by sqrt.

    Args:
        lines: shape (..., L, P).
        count: 1 to 1,000,000; it must divide L.

    Returns:
        The means, shape (..., L / count, P).

    Raises:
        InvalidParameter: L is no multiple of count, or there is but one line without an axis.
    """
    values = as_lines(lines)
    check_whole("count", count, 1, 1_000_000)
    number = values.shape[-2] if values.ndim > 1 else 1
    if number % count:
        raise InvalidParameter(
            f"{number} lines cannot be averaged {count} at a time; their number must be a "
            f"multiple of {count}",
            lines=number,
            count=count,
        )
    if values.ndim == 1:
        return values
    shape = (*values.shape[:-2], number // count, count, values.shape[-1])
    return np.asarray(values.reshape(shape).mean(axis=-2))
