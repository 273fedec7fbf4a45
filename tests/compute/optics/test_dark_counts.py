"""The distribution of dark pixels: against simulation step by step, and its draws against it."""

import numpy as np
import pytest
from scipy.stats import poisson

from compute.optics.dark_counts import CountDistribution
from compute.optics.detector import Detector
from tests.compute.optics.chi_square import chi2_excess

CASES = {
    "no light, read noise": Detector(12, 12.0, 64.0, 30.0, 60_000.0, 0.0),
    "few electrons": Detector(12, 1.5, 10.0, 2.0, 60_000.0, 5.0),
    "few electrons, no read noise": Detector(12, 1.5, 10.0, 0.0, 60_000.0, 5.0),
    "default": Detector(12, 12.0, 64.0, 30.0, 60_000.0, 400.0),
    "clipped at zero": Detector(8, 4.0, 0.0, 8.0, 60_000.0, 3.0),
    "clipped at full scale": Detector(8, 1.0, 0.0, 8.0, 60_000.0, 250.0),
    "clipped by the full well": Detector(10, 1.0, 20.0, 3.0, 400.0, 400.0),
    "16 bits, wide": Detector(16, 0.5, 100.0, 50.0, 60_000.0, 9_000.0),
    "with dark signal": Detector(12, 4.0, 64.0, 8.0, 60_000.0, 20.0, dark_electrons=30.0),
}


@pytest.mark.parametrize("name", CASES)
def test_draws_have_the_probabilities_of_the_distribution(name: str) -> None:
    dark = CASES[name].dark
    size = 1_000_000
    drawn = dark.draw(size, np.random.default_rng(11))
    assert set(np.unique(drawn)) <= set(dark.counts)
    observed = np.bincount(drawn - dark.counts[0].astype(np.int64), minlength=len(dark.counts))
    assert abs(chi2_excess(observed, size * dark.probabilities)) < 5.0


@pytest.mark.parametrize("name", CASES)
def test_the_distribution_is_that_of_the_detector_step_by_step(name: str) -> None:
    detector = CASES[name]
    rng = np.random.default_rng(12)
    size = 1_000_000
    electrons = np.minimum(
        rng.poisson(detector.ambient_electrons + detector.dark_electrons, size),
        detector.full_well_electrons,
    )
    electrons = electrons + detector.read_noise_electrons * rng.standard_normal(size)
    counts = np.floor(electrons / detector.electrons_per_count + detector.offset_counts + 0.5)
    counts = np.clip(counts, 0, 2**detector.bits - 1).astype(np.int64)
    dark = detector.dark
    lowest, length = int(dark.counts[0]), len(dark.counts)
    assert counts.min() >= lowest
    assert counts.max() < lowest + length
    observed = np.bincount(counts - lowest, minlength=length)
    assert abs(chi2_excess(observed, size * dark.probabilities)) < 5.0


def test_without_read_noise_and_at_unit_gain_it_is_poisson() -> None:
    dark = Detector(12, 1.0, 3.0, 0.0, 60_000.0, 20.0).dark
    np.testing.assert_allclose(
        dark.probabilities, poisson.pmf(dark.counts.astype(np.int64) - 3, 20.0), atol=1e-14
    )


@pytest.mark.parametrize("rest", [1e-7, 1e-4, 0.3])
def test_probabilities_below_a_place_of_the_table_are_kept(rest: float) -> None:
    """2^-16 is 1.5e-5: a rounded table would draw the rare count never, or much too often."""
    dark = CountDistribution(np.array([7, 9], dtype=np.uint16), np.array([1.0 - rest, rest]))
    size = 20_000_000
    rare = int((dark.draw(size, np.random.default_rng(13)) == 9).sum())
    assert abs(rare - size * rest) <= 5.0 * np.sqrt(size * rest)


def test_without_any_noise_every_draw_is_the_offset() -> None:
    dark = Detector(12, 12.0, 64.0, 0.0, 60_000.0, 0.0).dark
    assert set(dark.draw(100_000, np.random.default_rng(14))) == {64}
