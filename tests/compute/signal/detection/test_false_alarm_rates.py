"""False alarms: as many as chosen, by Monte Carlo on empty lines."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import multivariate_normal, norm, poisson

from compute.errors import InvalidParameter
from compute.signal.detection.false_alarms import FalseAlarms, _both_below
from compute.signal.detection.matched_filter import gaussian_filter
from compute.signal.detection.peak_detector import DetectionSettings, NoiseSource, PeakDetector
from compute.signal.sensor_noise import SensorNoise

RATES = (1e-3, 1e-2, 1e-1, 1.0)
SURE = 1e-5


def interval(found: int) -> tuple[float, float]:
    """Expected numbers that leave this one, or a rarer one, a chance of SURE on each side."""
    numbers = np.linspace(0.0, 2.0 * found + 40.0, 20001)
    low = numbers[poisson.sf(found - 1, numbers) >= SURE][0] if found else 0.0
    return float(low), float(numbers[poisson.cdf(found, numbers) >= SURE][-1])


def alarms(
    lines: NDArray[np.uint16], rate: float, source: NoiseSource, noise: SensorNoise, width: float
) -> int:
    detector = PeakDetector(
        gaussian_filter(width), lines.shape[1], DetectionSettings(rate, source, 64), noise
    )
    return int(detector.detect(lines).count.sum())


@pytest.mark.parametrize("rho", [-0.6, 0.0, 0.3, 0.99])
def test_two_normal_numbers_below_limits(rho: float) -> None:
    both = multivariate_normal([0.0, 0.0], [[1.0, rho], [rho, 1.0]])
    for h, k in ((0.3, 1.2), (-0.4, 0.9), (-1.0, -0.2), (2.0, 2.0), (0.0, 0.7)):
        found = float(_both_below(np.array([h]), np.array([k]), rho)[0])
        assert found == pytest.approx(float(both.cdf([h, k])), abs=1e-7)


def test_white_noise_without_a_filter_would_be_n_times_q() -> None:
    """Answers that hardly depend on their neighbours: N Q(t) less pairs; alike ones: fewer."""
    narrow, wide = (FalseAlarms.of(gaussian_filter(w), 512) for w in (0.4, 4.0))
    simple = 512 * norm.sf(4.0)
    assert 0.97 < narrow.expected(4.0) / simple < 1.03
    assert 0.3 < wide.expected(4.0) / simple < 0.5


@pytest.mark.slow
@pytest.mark.parametrize(("width", "pixels"), [(0.6, 64), (1.0, 256), (2.0, 128), (3.0, 512)])
def test_as_many_as_chosen_with_known_noise(width: float, pixels: int) -> None:
    """Short lines too, where the ends count."""
    rng = np.random.default_rng(11)
    lines = np.rint(rng.normal(1000.0, 20.0, (12000, pixels))).astype(np.uint16)
    noise = SensorNoise.of(1.0, 20.0, 1200.0)
    for rate in RATES:
        found = alarms(lines, rate, "model", noise, width)
        low, high = interval(found)
        assert low < rate * len(lines) < high, (rate, found)


@pytest.mark.slow
@pytest.mark.parametrize("source", ["line", "larger"])
def test_as_many_as_chosen_with_the_lines_own_noise(source: NoiseSource) -> None:
    """The uncertainty of the measured noise is reckoned with; the larger of two gives fewer."""
    rng = np.random.default_rng(12)
    pixels, noise = 512, SensorNoise.of(1.0, 20.0, 1200.0)
    lines = np.rint(rng.normal(1000.0, 20.0, (12000, pixels))).astype(np.uint16)
    for rate in RATES:
        found = alarms(lines, rate, source, noise, 2.0)
        low, high = interval(found)
        assert low < rate * len(lines)
        if source == "line":
            assert rate * len(lines) < high
        else:
            # The model is right: the line's own deviation, where larger, only hides more.
            known = alarms(lines, rate, "model", noise, 2.0)
            assert found <= known


def test_a_wrong_model_is_seen_by_the_lines_own_noise() -> None:
    rng = np.random.default_rng(13)
    lines = np.rint(rng.normal(1000.0, 20.0, (5000, 512))).astype(np.uint16)
    quiet = SensorNoise.of(1.0, 15.0, 1200.0)
    assert alarms(lines, 0.01, "model", quiet, 2.0) > 10 * 0.01 * 5000
    for source in ("line", "larger"):
        assert interval(alarms(lines, 0.01, source, quiet, 2.0))[0] < 0.01 * 5000


@pytest.mark.slow
@pytest.mark.parametrize("electrons", [100, 1000, 10000])
def test_photon_noise_has_more_by_its_skewness(electrons: int) -> None:
    """Prints how far the tail of photon noise bends the rate, beside Edgeworth's first term."""
    rng = np.random.default_rng(14)
    lines = rng.poisson(electrons, (12000, 256)).astype(np.uint16)
    matched = gaussian_filter(2.0)
    skew = (matched.taps.astype(np.float64) ** 3).sum() / matched.norm**3 / np.sqrt(electrons)
    # The noise as it is, for Edgeworth's sake: as read noise, over an offset above the light.
    noise = SensorNoise.of(1.0, np.sqrt(electrons - 1.0 / 12.0), 65535.0)
    for rate in (1e-2, 1e-1):
        settings = DetectionSettings(rate, "model", 64)
        detector = PeakDetector(matched, 256, settings, noise)
        found = int(detector.detect(lines).count.sum())
        expected = np.exp(skew * detector.threshold_sigma**3 / 6.0)
        own = alarms(lines, rate, "line", SensorNoise.of(1.0, 0.0), 2.0)
        usual = alarms(lines, rate, "model", SensorNoise.of(1.0, 0.0), 2.0)
        chosen = rate * len(lines)
        print(
            f"{electrons} electrons, {rate} a line: {found / chosen:.2f} times as many, "
            f"by the series {expected:.2f}; by the line's noise {own / chosen:.2f}, "
            f"by SensorNoise {usual / chosen:.2f} (+- {1 / np.sqrt(chosen):.2f})"
        )
        low, high = interval(found)
        # The series' next terms: a tenth of the first one's exponent.
        slack = 1.0 + 0.1 * np.log(expected)
        assert low / slack < expected * chosen < high * slack


@pytest.mark.slow
@pytest.mark.parametrize("sigma", [0.2, 0.3, 0.5, 0.6, 0.8])
def test_noise_that_counts_hardly_resolve(sigma: float) -> None:
    """Prints the rates of lines whose noise is a count or less, by where the level lies."""
    rng = np.random.default_rng(15)
    rates = (1e-2, 1e-1, 1.0)
    for level in (0.0, 0.25, 0.5):
        lines = np.rint(rng.normal(1000.0 + level, sigma, (3000, 512))).astype(np.uint16)
        found = [alarms(lines, rate, "line", SensorNoise.of(1.0, 0.0), 2.0) for rate in rates]
        shares = ", ".join(f"{n / len(lines) / r:.2f}" for n, r in zip(found, rates, strict=True))
        print(f"noise {sigma} counts, level {level} counts above a whole one: {shares} of chosen")
        for number, rate in zip(found, rates, strict=True):
            low, high = interval(number)
            # Rounding leaves a tenth of the rate in doubt at 0.6 counts, where the line's
            # squares are still coarse; below half a count there are fewer than chosen.
            assert low < 1.1 * rate * len(lines), (sigma, level, rate)
            if sigma >= 0.8:
                assert rate * len(lines) < high, (sigma, level, rate)


def test_what_no_threshold_gives_is_refused() -> None:
    with pytest.raises(InvalidParameter, match="false_alarms_per_line is 400"):
        FalseAlarms.of(gaussian_filter(2.0), 512).threshold_sigma(400.0)
    with pytest.raises(InvalidParameter, match="false_alarms_per_line is 1e-40"):
        FalseAlarms.of(gaussian_filter(2.0), 512).threshold_sigma(1e-40)


def test_an_uncertain_noise_costs_a_higher_threshold() -> None:
    law = FalseAlarms.of(gaussian_filter(2.0), 2048)
    thresholds = [law.threshold_sigma(0.01, dof) for dof in (np.inf, 1e6, 200.0, 100.0)]
    assert thresholds == sorted(thresholds)
    assert thresholds[1] == pytest.approx(thresholds[0], abs=1e-4)
    assert law.expected(thresholds[3], 100.0) == pytest.approx(0.01, rel=1e-6)
