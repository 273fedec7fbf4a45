"""Control points cut into blocks of space, which a cross-validation leaves out one by one."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MAX_BLOCKS: Final = 16
MIN_BLOCKS: Final = 5
POINTS_PER_BLOCK: Final = 3


def block_count(points: int) -> int:
    """Return into how many blocks so many points are cut: three points each, 5 to 16 of them."""
    return int(min(points, max(MIN_BLOCKS, min(MAX_BLOCKS, points // POINTS_PER_BLOCK))))


def spatial_block_index(points_mm: Array, count: int) -> NDArray[np.intp]:
    """Return the number of each point's block, 0 .. count - 1, shape (N,).

    The points are halved across their longest extent, again and again. What a model gets wrong is
    alike in neighbouring points: left out one by one, each would be predicted from neighbours
    that err as it does.

    Args:
        points_mm: shape (N, 3).
        count: of blocks, at most N.
    """
    blocks = np.zeros(len(points_mm), dtype=np.intp)
    parts = [(np.arange(len(points_mm)), 0, count)]
    while parts:
        rows, first, share = parts.pop()
        if share == 1:
            blocks[rows] = first
            continue
        extent = np.ptp(points_mm[rows], axis=0)
        order = rows[np.argsort(points_mm[rows, int(extent.argmax())], kind="stable")]
        low = share // 2
        cut = round(len(rows) * low / share)
        parts.append((order[:cut], first, low))
        parts.append((order[cut:], first + low, share - low))
    return blocks
