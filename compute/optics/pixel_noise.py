"""Counts of unlit pixels that all differ in mean and offset, drawn from tables."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.optics.dark_counts import TABLE_SIZE, random_indices
from compute.optics.detector import Detector

Array = NDArray[np.float64]

SMOOTH_READ_NOISE_ELECTRONS: Final = 0.8
"""The lowest read noise at which single electrons cannot be distinguished: the ripple that they
leave on the distribution is below exp(-2 pi^2 0.8^2) = 3e-6, so that it may be shifted."""

_STEP: Final = 1.0 / 32.0  # of the variance from one table to the next, relative
_DITHER: Final = 1.0 / 4.0  # width of the dither, in the smallest deviation
_DITHERS: Final = 16384
_TAIL: Final = 32  # entries at each end that stand for a tail
_TAIL_STEP: Final = 1.0 / 8.0  # of the tail's table, in -ln of the probability
_TAIL_REACH: Final = 22.0  # where it ends: 5e-4 exp(-22) = 1e-13
_AT_ONCE: Final = 8192
_ABSENT: Final = np.iinfo(np.int16).min  # an entry that stands for a tail


class PixelNoise:
    """Counts of P unlit pixels, each with its own mean number of electrons and offset.

    A pixel's electrons are ``mean + d``, and the cumulants of d (Poisson less its mean, plus
    the Gaussian read noise) are linear in the mean. Its distribution is tabulated as 65536
    quantiles for variances 1/32 apart, all tables in the same bit-reversed order and one after
    the other. A pixel draws from a window of 65536 entries that begins so far into its lower
    table that the variance is right: every quantile occurs once, from the lower or the upper
    table. A uniform dither a quarter of a deviation wide, which was taken out of the quantiles
    beforehand, fills the gaps between them; it is a fixed sequence begun anywhere, for speed.
    The sum is added to the pixel's own mean and rounded to a count.

    Mean, variance and third moment are those of the pixel; only from the fourth moment on does
    the mixture differ: by chi-square of at most ``24 / 1024 / 32^4 = 2e-8`` per draw. With the
    finite number of quantiles and a fixed point of some 1e-4 deviations, all that is left is
    about 1e-6 per draw (measured with 2e7 draws, 3 to 80 counts to a deviation): it takes a
    million exposures of a pixel and more to tell it from the exact one. Beyond the 32nd
    quantile from either end the value is drawn from the tail's own table, down to 1e-13; at 5
    deviations the probability is off by up to 1.5 %.

    Args:
        detector: the pixels' common parameters; its full well must be out of reach.
        mean_electrons: mean electrons without signal, shape (P,).
        offset_counts: shape (P,).

    The read noise must be at least SMOOTH_READ_NOISE_ELECTRONS.
    """

    def __init__(self, detector: Detector, mean_electrons: Array, offset_counts: Array) -> None:
        gain, read_noise = detector.electrons_per_count, detector.read_noise_electrons
        variance = mean_electrons + read_noise**2
        lowest, highest = float(variance.min()), float(variance.max())
        steps = int(np.ceil(np.log(highest / lowest) / np.log1p(_STEP)))
        nodes = lowest * (1.0 + _STEP) ** np.arange(steps + 1)
        # A fixed point as fine as 16 bits allow: the quantiles kept reach 7 deviations at most.
        self._shift = int(np.floor(np.log2(32000.0 / (7.3 * np.sqrt(highest) / gain + 2.0))))
        unit = 2**self._shift
        steps_of_dither = max(1, round(_DITHER * np.sqrt(lowest) / gain * unit))
        self._dithers = _dithers(steps_of_dither)
        quantiles = [
            _quantiles(max(node - read_noise**2, 0.0), read_noise, gain / unit, steps_of_dither)
            for node in nodes
        ]
        self._tails = np.array([quantile[1] for quantile in quantiles]) / gain
        self._pixels = len(variance)
        self._unit = unit
        # Rounded down, ``entry + dither + fraction`` passes a whole count where it should.
        table = np.floor(np.array([quantile[0] for quantile in quantiles]) * (unit / gain))
        reach = float(np.abs(table[:, _TAIL:-_TAIL]).max() + steps_of_dither) / unit
        table = table.clip(-32767, 32767).astype(np.int16)
        table[:, :_TAIL] = table[:, -_TAIL:] = _ABSENT
        self._rank = _bit_reversed()
        self._table = np.ascontiguousarray(table[:, self._rank]).ravel()

        lower = np.clip(np.searchsorted(nodes, variance, side="right") - 1, 0, max(steps - 1, 0))
        upper = np.minimum(lower + 1, steps)
        share = (variance - nodes[lower]) / np.maximum(nodes[upper] - nodes[lower], 1e-300)
        self._start = np.rint((lower + share.clip(0.0, 1.0)) * TABLE_SIZE).astype(np.int64)
        if steps == 0:
            self._start[:] = 0

        self._full_scale = detector.full_scale
        self._centre = mean_electrons / gain + offset_counts + 0.5
        span = int(np.ceil(reach)) + 2
        # Farther out than the noise reaches, the count is clipped wherever the centre is.
        floor = np.floor(self._centre.clip(-span - 1.0, self._full_scale + span + 1.0))
        fraction = (self._centre - floor).clip(0.0, 1.0)
        self._fraction = np.rint(fraction * unit).astype(np.int16)
        self._clips = bool(floor.min() < span or floor.max() > self._full_scale - span)
        self._lowest = (-floor).clip(-32768, 32767).astype(np.int16)
        self._highest = (self._full_scale - floor).clip(-32768, 32767).astype(np.int16)
        self._floor = floor.astype(np.int64).astype(np.uint16)

    def draw(self, exposures: int, rng: np.random.Generator) -> NDArray[np.uint16]:
        """Return independent counts, shape (exposures, P).

        Args:
            exposures: how many exposures.
            rng: source of the noise.
        """
        drawn = np.empty((exposures, self._pixels), dtype=np.int16)
        counts = drawn.view(np.uint16)
        index = np.empty(min(_AT_ONCE, self._pixels), dtype=np.int64)
        tails, entries = [], []
        # In blocks, so that what is worked on stays in the cache.
        for first in range(0, self._pixels, _AT_ONCE):
            block = slice(first, first + _AT_ONCE)
            start, fraction, floor = self._start[block], self._fraction[block], self._floor[block]
            at = index[: len(start)]
            for exposure in range(exposures):
                entry = drawn[exposure, block]
                indices = random_indices(len(start) + 1, rng)
                np.copyto(at, indices[:-1])
                at += start
                begin = int(indices[-1]) % _DITHERS
                np.take(self._table, at, out=entry, mode="wrap")
                tail = np.flatnonzero(entry == _ABSENT)
                entries.append(at[tail])
                tails.append(tail + (exposure * self._pixels + first))
                entry += fraction
                entry += self._dithers[begin : begin + len(start)]
                entry >>= self._shift
                if self._clips:
                    np.maximum(entry, self._lowest[block], out=entry)
                    np.minimum(entry, self._highest[block], out=entry)
                # Modulo 65536, as counts of 16 bits do not fit into int16.
                counts[exposure, block] += floor
        flat = np.concatenate(tails)
        tail_counts = self._tail_counts(np.concatenate(entries), flat % self._pixels, rng)
        counts.reshape(-1)[flat] = tail_counts
        return counts

    def _tail_counts(
        self, entry: NDArray[np.int64], pixel: NDArray[np.int64], rng: np.random.Generator
    ) -> NDArray[np.uint16]:
        side = (self._rank[entry % TABLE_SIZE] >= _TAIL).astype(np.int64)
        depth = rng.standard_exponential(len(entry)) / _TAIL_STEP
        depth = np.minimum(depth, self._tails.shape[2] - 1.001)
        cell = depth.astype(np.int64)
        near = self._tails[entry // TABLE_SIZE, side, cell]
        far = self._tails[entry // TABLE_SIZE, side, cell + 1]
        dither = rng.choice(self._dithers[:_DITHERS], len(entry)) / self._unit
        value = np.floor(near + (far - near) * (depth - cell) + dither + self._centre[pixel])
        counts: NDArray[np.uint16] = value.clip(0, self._full_scale).astype(np.uint16)
        return counts


def _quantiles(
    mean: float, read_noise: float, unit: float, steps_of_dither: int
) -> tuple[Array, Array]:
    """Return the quantiles of Poisson less its mean plus Gaussian noise, less the dither.

    The cells' probabilities come from the characteristic function, by a Fourier transform.

    Returns:
        Quantiles in the middle of 65536 equal parts, shape (65536,), and beyond the 32nd from
        the lower and the upper end, by steps of -ln(probability), shape (2, K) [electrons].
    """
    sigma = np.sqrt(mean + read_noise**2)
    # 13 deviations downwards (a Poisson number has no more) and 30 upwards, for its skewness.
    width = min(sigma / 256.0, read_noise / 2.0)
    size = int(2 ** np.ceil(np.log2(43.0 * sigma / width)))
    lower = -13.0 * sigma
    t = 2.0 * np.pi * np.fft.rfftfreq(size, width)
    # Beyond it there is but the ripple of single electrons, where the dither has zeros.
    t = t[t < 16.0 / sigma]
    log = mean * (np.exp(1j * t) - 1.0 - 1j * t) - 0.5 * (read_noise * t) ** 2
    # The dither: steps_of_dither values one unit apart, the lowest zero.
    half = 0.5 * unit * t
    dither = np.ones_like(t)
    dither[1:] = np.sin(steps_of_dither * half[1:]) / (steps_of_dither * np.sin(half[1:]))
    centre = lower + 0.5 * width
    wave = np.exp(log - 1j * t * centre) / dither * np.sinc(t * width / (2.0 * np.pi))
    cells = np.fft.irfft(wave.conj(), size).clip(1e-19)
    below, above = np.cumsum(cells), np.cumsum(cells[::-1])
    edges = lower + width * np.arange(1, size + 1)
    body = np.interp((np.arange(TABLE_SIZE) + 0.5) / TABLE_SIZE, below / below[-1], edges)
    log_tail = np.log(_TAIL / TABLE_SIZE) - np.arange(0.0, _TAIL_REACH, _TAIL_STEP)
    tails = np.array(
        [
            np.interp(log_tail[::-1], np.log(below / below[-1]), edges)[::-1],
            np.interp(log_tail[::-1], np.log(above / above[-1]), edges[::-1] - width)[::-1],
        ]
    )
    shift = 0.5 * (steps_of_dither - 1) * unit  # the dither's mean
    return body - shift, tails - shift


def _dithers(steps: int) -> NDArray[np.int16]:
    """Return the numbers 0 to steps - 1 equally often, in random order, and some once more.

    A run of 8192 of them may begin at any of the first 16384.
    """
    values = np.arange(_DITHERS, dtype=np.int64) * steps // _DITHERS
    shuffled = np.random.default_rng(0).permutation(values).astype(np.int16)
    return np.concatenate([shuffled, shuffled[:_AT_ONCE]])


def _bit_reversed() -> NDArray[np.int64]:
    """Return the numbers 0 to 65535 with their 16 bits reversed, shape (65536,).

    Any run of them is spread evenly over the whole: so is what a window takes from a table.
    """
    numbers = np.arange(TABLE_SIZE, dtype=np.int64)
    reversed_bits = np.zeros_like(numbers)
    for bit in range(16):
        reversed_bits |= ((numbers >> bit) & 1) << (15 - bit)
    return reversed_bits
