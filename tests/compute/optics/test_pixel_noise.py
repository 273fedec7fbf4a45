"""Pixels that all differ in mean and offset: their counts against the exact distribution."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from compute.optics.dark_counts import CountDistribution, count_distribution, random_indices
from compute.optics.detector import Detector
from compute.optics.pixel_noise import PixelNoise
from tests.compute.optics.chi_square import chi2_excess

Array = NDArray[np.float64]
PIXELS = 8192


def generator(seed: int) -> np.random.Generator:
    return np.random.Generator(np.random.SFC64(seed))


def exact(detector: Detector, mean: float, offset: float) -> CountDistribution:
    # Step by step, this was checked in test_optics_dark. A negative offset is a pixel's own.
    return count_distribution(
        lambda electrons: detector.convert(electrons, np.full_like(electrons, offset)),
        lambda counts: (counts + (0.5 - offset)) * detector.electrons_per_count,
        mean_electrons=mean,
        full_well_electrons=detector.full_well_electrons,
        read_noise_electrons=detector.read_noise_electrons,
    )


def excess(detector: Detector, lowest: float, mean: float, highest: float, offset: float) -> float:
    """Return the excess of chi2 of 2e7 draws; the tables span lowest to highest electrons."""
    means = np.full(PIXELS, mean)
    means[:2] = lowest, highest
    noise = PixelNoise(detector, means, np.full(PIXELS, offset))
    observed = np.zeros(65536, dtype=np.int64)
    rng = generator(21)
    draws = 2442
    for _ in range(0, draws, 37):
        observed += np.bincount(noise.draw(37, rng)[:, 2:].ravel(), minlength=65536)
    expected = np.zeros(65536)
    distribution = exact(detector, mean, offset)
    expected[distribution.counts] = distribution.probabilities
    return chi2_excess(observed, observed.sum() * expected)


DEFAULT = Detector(12, 12.0, 64.0, 30.0, 60_000.0, 0.0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("detector", "lowest", "mean", "highest", "offset"),
    [
        (DEFAULT, 400.0, 400.0, 400.0, 64.0),
        (DEFAULT, 100.0, 815.5, 4000.0, 63.37),  # between two tables
        (DEFAULT, 0.0, 0.0, 4000.0, 64.9),
        (DEFAULT, 0.0, 4000.0, 4000.0, 10.0),
        (replace(DEFAULT, electrons_per_count=120.0), 100.0, 777.0, 900.0, 5.499),
        (replace(DEFAULT, bits=16, electrons_per_count=0.5), 50.0, 60.3, 5000.0, 500.2),
        (replace(DEFAULT, read_noise_electrons=0.8, electrons_per_count=1.0), 0.0, 0.7, 3.0, 20.3),
        (replace(DEFAULT, read_noise_electrons=2.0), 9.0, 12.5, 16.0, 2.0),
        # Clipped at zero, with an offset that is below it; and at full scale.
        (DEFAULT, 0.0, 20.0, 100.0, -3.4),
        (replace(DEFAULT, bits=8), 0.0, 2330.0, 4000.0, 60.0),
        (replace(DEFAULT, bits=16, electrons_per_count=0.8), 5e4, 52_300.0, 5.3e4, 150.0),
    ],
)
def test_two_times_ten_to_the_seven_draws_of_a_pixel_do_not_tell_it_from_the_exact_one(
    detector: Detector, lowest: float, mean: float, highest: float, offset: float
) -> None:
    """What the tables leave is about 1e-6 in chi2 per draw, 20 in all; the least of five
    deviations here are 20, and they grow with the number of counts."""
    assert abs(excess(detector, lowest, mean, highest, offset)) < 5.0


def test_the_far_tails_are_drawn() -> None:
    """Beyond five deviations: one place of 65536 would cut them off at 4.3."""
    mean, offset = np.linspace(390.0, 410.0, PIXELS), np.full(PIXELS, 64.0)
    noise = PixelNoise(DEFAULT, mean, offset)
    rng = generator(5)
    sigma = np.sqrt(1300.0)
    high = offset.mean() + np.ceil((400.0 + 5.0 * sigma) / 12.0)
    low = offset.mean() + np.floor((400.0 - 4.7 * sigma) / 12.0)
    distribution = exact(DEFAULT, 400.0, 64.0)
    above = below = 0
    blocks, exposures = 140, 64
    for _ in range(blocks):
        counts = noise.draw(exposures, rng)
        above += int((counts >= high).sum())
        below += int((counts <= low).sum())
    draws = blocks * exposures * PIXELS
    # The pixels' means differ by a quarter of a deviation: averaged over, in steps of 1/100.
    for seen, side in ((above, 1), (below, -1)):
        tail = np.mean(
            [
                _beyond(exact(DEFAULT, one, 64.0), high if side > 0 else low, side)
                for one in np.linspace(390.0, 410.0, 41)
            ]
        )
        assert draws * tail > 20.0
        assert abs(seen - draws * tail) < 5.0 * np.sqrt(draws * tail)
    assert distribution.counts[0] < low


def _beyond(distribution: CountDistribution, edge: float, side: int) -> float:
    counts = distribution.counts.astype(np.float64)
    return float(distribution.probabilities[side * counts >= side * edge].sum())


@pytest.mark.slow
@settings(max_examples=12, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    read_noise=st.floats(0.8, 60.0),
    gain=st.floats(0.5, 40.0),
    lowest=st.floats(0.0, 500.0),
    span=st.floats(0.0, 1500.0),
)
def test_every_pixel_keeps_its_own_mean_and_variance(
    seed: int, read_noise: float, gain: float, lowest: float, span: float
) -> None:
    rng = generator(seed)
    detector = Detector(16, gain, 0.0, read_noise, 1e7, 0.0)
    mean = lowest + span * rng.random(200)
    # Offsets that keep zero out of reach.
    offset = 40.0 + 8.0 * read_noise / gain + 60.0 * rng.random(200)
    counts = PixelNoise(detector, mean, offset).draw(2000, rng).astype(np.float64)
    variance = (mean + read_noise**2) / gain**2
    deviation = (counts.mean(axis=0) - mean / gain - offset) / np.sqrt((variance + 0.25) / 2000)
    # Where a count is wide beside the noise, rounding shifts the mean: by its ripple, whose
    # harmonics add up to half a count at most.
    harmonic = np.arange(1, 40)[:, None]
    ripple = np.exp(-2.0 * np.pi**2 * harmonic**2 * variance) / (np.pi * harmonic)
    ripple = np.minimum(ripple.sum(axis=0), 0.5)
    bound = 6.0 + ripple / np.sqrt((variance + 0.25) / 2000)
    assert (abs(deviation) < bound).all()
    wide = variance > 1.0
    ratio = counts.var(axis=0)[wide] / (variance[wide] + 1.0 / 12.0)
    kurtosis = 1.0 / (mean + read_noise**2)[wide]
    assert (abs(ratio - 1.0) < 6.5 * np.sqrt((2.0 + kurtosis) / 2000)).all()


def test_neighbours_and_exposures_are_independent() -> None:
    rng = generator(8)
    noise = PixelNoise(DEFAULT, rng.uniform(300.0, 900.0, PIXELS), rng.uniform(60.0, 70.0, PIXELS))
    counts = noise.draw(100, rng).astype(np.float64)
    counts -= counts.mean(axis=0)
    for first, second in ((counts[:, :-1], counts[:, 1:]), (counts[:-1], counts[1:])):
        size = first.size
        correlation = np.corrcoef(first.ravel(), second.ravel())[0, 1]
        # Taking off the mean of 100 exposures alone makes them -1/100 alike.
        due = -1.0 / 100.0 if first.shape[0] < 100 else 0.0
        assert correlation == pytest.approx(due, abs=5.0 / np.sqrt(size))


@pytest.mark.parametrize("kind", [np.random.SFC64, np.random.PCG64, np.random.MT19937])
@pytest.mark.parametrize("size", [1, 3, 4, 101])
def test_places_are_uniform_whatever_the_generator(
    kind: type[np.random.BitGenerator], size: int
) -> None:
    rng = np.random.Generator(kind(4))
    drawn = np.concatenate([random_indices(size, rng) for _ in range(20_000)])
    assert drawn.dtype == np.uint16
    assert random_indices(size, rng).shape == (size,)
    for low_bits in (drawn >> 8, drawn & 255):
        observed = np.bincount(low_bits, minlength=256)
        assert abs(chi2_excess(observed, np.full(256, len(drawn) / 256))) < 5.0
