"""The detector's noise against theory, its conversion and its limits."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from compute.optics.detector import Detector

FINE = Detector(
    bits=16,
    electrons_per_count=1.0,
    offset_counts=100.0,
    read_noise_electrons=20.0,
    full_well_electrons=60_000.0,
    ambient_electrons=50.0,
)
SIZE = 400_000


def exposed(detector: Detector, mean_electrons: float, seed: int = 5) -> NDArray[np.float64]:
    signal = np.full((4, SIZE // 4), mean_electrons)
    counts = detector.expose(signal, np.random.default_rng(seed))
    assert counts.shape == signal.shape
    assert counts.dtype == np.uint16
    return counts.astype(np.float64)


@pytest.mark.parametrize("mean_electrons", [0.0, 0.3, 10.0, 63.0, 65.0, 1000.0, 30_000.0])
def test_mean_and_variance_are_those_of_photon_read_and_quantisation_noise(
    mean_electrons: float,
) -> None:
    counts = exposed(FINE, mean_electrons)
    collected = mean_electrons + FINE.ambient_electrons
    variance = collected + FINE.read_noise_electrons**2 + 1.0 / 12.0
    # Five standard deviations of the estimates; the excess kurtosis of Poisson is below 1/50.
    assert counts.mean() - 100.0 - collected == pytest.approx(0, abs=5 * np.sqrt(variance / SIZE))
    assert counts.var() / variance == pytest.approx(1.0, abs=5 * np.sqrt(2.02 / SIZE))


@pytest.mark.parametrize("mean_electrons", [0.0, 2.0, 200.0])
def test_the_third_moment_is_that_of_poisson(mean_electrons: float) -> None:
    """A normal approximation of the photon noise would have none."""
    detector = replace(FINE, read_noise_electrons=0.0, ambient_electrons=4.0)
    counts = exposed(detector, mean_electrons)
    mean = mean_electrons + 4.0
    third = ((counts - counts.mean()) ** 3).mean()
    assert third == pytest.approx(mean, abs=5 * np.sqrt((15 * mean**3 + 60 * mean**2) / SIZE))


def test_the_gain_divides_mean_and_variance() -> None:
    counts = exposed(replace(FINE, electrons_per_count=2.0), 5000.0)
    variance = (5050.0 + 400.0) / 4.0 + 1.0 / 12.0
    assert counts.mean() == pytest.approx(100.0 + 2525.0, abs=5 * np.sqrt(variance / SIZE))
    assert counts.var() / variance == pytest.approx(1.0, abs=5 * np.sqrt(2.02 / SIZE))


@pytest.mark.parametrize("mean_electrons", [0.0, 500.0])
def test_neighbouring_pixels_are_independent(mean_electrons: float) -> None:
    counts = exposed(FINE, mean_electrons).ravel()
    assert abs(np.corrcoef(counts[:-1], counts[1:])[0, 1]) < 5.0 / np.sqrt(SIZE)


def test_lit_pixels_do_not_touch_dark_ones() -> None:
    signal = np.zeros((2, 1000))
    signal[1, 400:420] = 5000.0
    lit = FINE.expose(signal, np.random.default_rng(9))
    dark = FINE.expose(np.zeros((2, 1000)), np.random.default_rng(9))
    assert (lit != dark).nonzero()[0].tolist() == [1] * 20
    assert lit[1, 400:420].min() > 4000


@pytest.mark.parametrize("bits", range(8, 17))
def test_the_count_is_clipped_at_full_scale(bits: int) -> None:
    detector = replace(FINE, bits=bits, full_well_electrons=1e6)
    assert detector.full_scale == 2**bits - 1
    counts = exposed(detector, 500_000.0)
    assert set(np.unique(counts)) == {2**bits - 1}


def test_the_full_well_ends_the_photon_noise() -> None:
    counts = exposed(replace(FINE, full_well_electrons=2000.0), 50_000.0)
    variance = FINE.read_noise_electrons**2 + 1.0 / 12.0
    assert counts.mean() == pytest.approx(2100.0, abs=5 * np.sqrt(variance / SIZE))
    assert counts.var() / variance == pytest.approx(1.0, abs=5 * np.sqrt(2.0 / SIZE))


def test_full_counts_are_where_a_pixel_says_at_least_only() -> None:
    """Of a full pixel, all but 3 in 100,000 counts reach it."""
    shallow = replace(FINE, full_well_electrons=2000.0)
    assert shallow.full_counts < shallow.full_scale
    counts = exposed(shallow, 50_000.0)
    assert (counts >= shallow.full_counts).mean() > 0.9998
    assert (exposed(shallow, 1000.0) < shallow.full_counts).all()
    deep = replace(FINE, bits=8, full_well_electrons=1e6)
    assert deep.full_counts == deep.full_scale
    assert replace(FINE, full_well_electrons=1e-3, offset_counts=0.0).full_counts == 1


def test_conversion_rounds_to_the_nearest_count_and_clips() -> None:
    detector = Detector(8, 10.0, 2.0, 0.0, 1e5, 0.0)
    electrons = np.array([-1e6, -25.1, 0.0, 4.9, 5.0, 14.9, 2524.9, 2525.0, 1e9])
    assert detector.convert(electrons).tolist() == [0, 0, 2, 2, 3, 3, 254, 255, 255]


def test_the_same_generator_gives_the_same_counts_and_another_seed_others() -> None:
    first, again, other = (exposed(FINE, 100.0, seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert (first != other).mean() > 0.9


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("bits", 7),
        ("bits", 17),
        ("electrons_per_count", 0.0),
        ("electrons_per_count", np.nan),
        ("offset_counts", -1.0),
        ("read_noise_electrons", -0.1),
        ("full_well_electrons", 0.0),
        ("full_well_electrons", np.inf),
        ("ambient_electrons", -5.0),
    ],
)
def test_values_without_meaning_are_refused(field: str, value: float) -> None:
    with pytest.raises(InvalidParameter, match=f"{field} is {value}; it must be"):
        replace(FINE, **{field: value})
