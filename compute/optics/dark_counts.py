"""Counts of pixels without signal: exact distribution, and fast draws from it."""

from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln, ndtr, xlogy

Array = NDArray[np.float64]

TABLE_SIZE: Final = 65536
"""Entries of a table from which a 16-bit random number draws."""


def random_indices(size: int, rng: np.random.Generator) -> NDArray[np.uint16]:
    """Return independent, uniform integers from 0 to 65535, shape (size,).

    Args:
        size: how many.
        rng: source of the numbers.
    """
    if isinstance(rng.bit_generator, np.random.MT19937):  # its raw numbers have 32 bits only
        return rng.integers(0, TABLE_SIZE, size, dtype=np.uint16)
    # Four indices from each raw number of 64 bits: five times as fast as Generator.integers.
    raw = rng.bit_generator.random_raw((size + 3) // 4)
    return np.asarray(raw, dtype=np.uint64).view(np.uint16)[:size]


_REACH_SIGMA = 9.0  # beyond it lies less than 1e-18

_BLOCK = 64

_DRAWN_AT_ONCE = 8192


class CountDistribution:
    """Distribution of counts, drawn by a table of 65536 equally probable entries.

    A count of probability p fills ``floor(65536 p)`` entries. The entries left over stand for
    what the rounding cut off, and are drawn from exactly that remainder by inversion: the
    mixture has the given probabilities, not rounded ones.

    Args:
        counts: the possible counts, ascending, uint16, shape (K,).
        probabilities: of these counts, shape (K,), adding up to 1.
    """

    def __init__(self, counts: NDArray[np.uint16], probabilities: Array) -> None:
        self.counts = counts
        self.probabilities = probabilities
        indices = np.floor(TABLE_SIZE * probabilities)
        rest = TABLE_SIZE * probabilities - indices
        self._filled = int(indices.sum())
        self._table = np.zeros(TABLE_SIZE, dtype=np.uint16)
        self._table[: self._filled] = np.repeat(counts, indices.astype(np.int64))
        self._rest_cdf = np.cumsum(rest) / max(float(rest.sum()), np.finfo(np.float64).tiny)

    def draw(self, size: int, rng: np.random.Generator) -> NDArray[np.uint16]:
        """Return independent counts, shape (size,).

        Args:
            size: how many.
            rng: source of the noise.
        """
        indices = random_indices(size, rng)
        drawn = np.empty(size, dtype=np.uint16)
        # In blocks: take converts its indices, and a large temporary costs page faults.
        for start in range(0, size, _DRAWN_AT_ONCE):
            block = slice(start, start + _DRAWN_AT_ONCE)
            np.take(self._table, indices[block], out=drawn[block], mode="wrap")
        unfilled = np.flatnonzero(indices >= self._filled)
        index = np.searchsorted(self._rest_cdf, rng.random(len(unfilled)), side="right")
        drawn[unfilled] = self.counts[np.minimum(index, len(self.counts) - 1)]
        return drawn


def count_distribution(
    convert: Callable[[Array], NDArray[np.uint16]],
    edges: Callable[[NDArray[np.int64]], Array],
    *,
    mean_electrons: float,
    full_well_electrons: float,
    read_noise_electrons: float,
) -> CountDistribution:
    """Return the distribution of one pixel's count: Poisson, full well, Gaussian, converter.

    Args:
        convert: electrons to counts, not decreasing.
        edges: the electrons from which on a count is larger than the given one.
        mean_electrons: mean of the Poisson distribution.
        full_well_electrons: what the pixel holds at most.
        read_noise_electrons: standard deviation of the Gaussian noise; may be zero.
    """
    reach = _REACH_SIGMA * np.sqrt(mean_electrons)
    number = np.arange(max(0.0, np.floor(mean_electrons - reach)), mean_electrons + reach + 40.0)
    weight = np.exp(xlogy(number, mean_electrons) - gammaln(number + 1.0) - mean_electrons)
    weight /= weight.sum()
    electrons = np.minimum(number, full_well_electrons)
    noise = _REACH_SIGMA * read_noise_electrons
    lowest, highest = convert(np.array([electrons[0] - noise, electrons[-1] + noise])).tolist()
    counts = np.arange(lowest, highest + 1)
    if read_noise_electrons == 0.0:
        probabilities = np.bincount(
            convert(electrons).astype(np.int64) - lowest, weight, minlength=len(counts)
        )
    else:
        upper = edges(counts[:-1])
        cumulated = np.zeros(len(upper))
        for start in range(0, len(electrons), _BLOCK):  # in blocks, to bound the memory
            block = slice(start, start + _BLOCK)
            z = (upper[:, None] - electrons[block]) / read_noise_electrons
            cumulated += ndtr(z) @ weight[block]
        probabilities = np.diff(cumulated, prepend=0.0, append=1.0).clip(0.0)
    return CountDistribution(counts.astype(np.uint16), probabilities / probabilities.sum())
