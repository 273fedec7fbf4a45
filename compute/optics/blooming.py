"""Blooming: charge above the full well flows into the neighbouring pixels."""

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solveh_banded

Array = NDArray[np.float64]


def bloom(
    charge: Array, linked: NDArray[np.bool_], full_well: float, share: float
) -> tuple[Array, Array]:
    """Distribute charge above the full well to the neighbours until none is above it.

    Of the charge that leaves a pixel, half the share goes to each of its neighbours and the
    rest is drained; what goes to a neighbour that is not there is lost. With q the charge and
    f >= 0 what leaves a pixel in all, the pixels keep ``q_i - f_i + share/2 (f_i-1 + f_i+1)``,
    at most the full well, and f is the smallest flow that does it: zero where the well is not
    full. The pixels above are linear equations, banded; those that they fill join them.

    Args:
        charge: electrons of the pixels, shape (P,).
        linked: whether pixel i + 1 is the right neighbour of pixel i, shape (P - 1,).
        full_well: what a pixel holds at most [electrons].
        share: share of the excess that flows on, 0 to 1.

    Returns:
        What the pixels keep, and what left each of them in all, both of shape (P,).
    """
    flow = np.zeros_like(charge)
    kept = charge
    full = charge > full_well
    added = full
    half = 0.5 * share
    while added.any():
        # The set only grows: more pixels that pass charge on fill no well less.
        full = full | added
        at = np.flatnonzero(full)
        # One unknown more, which is zero: the solver refuses a single one.
        band = np.zeros((2, len(at) + 1))
        band[0] = 1.0
        band[1, : len(at) - 1] = np.where((np.diff(at) == 1) & linked[at[:-1]], -half, 0.0)
        excess = np.append(charge[at] - full_well, 0.0)
        flow[at] = solveh_banded(band, excess, lower=True)[:-1]
        kept = charge - flow
        kept[1:] += half * np.where(linked, flow[:-1], 0.0)
        kept[:-1] += half * np.where(linked, flow[1:], 0.0)
        added = (kept > full_well) & ~full
    return np.minimum(kept, full_well), flow
