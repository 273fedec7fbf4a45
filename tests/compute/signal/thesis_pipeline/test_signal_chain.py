"""SignalChain: every step an option, centroids with honest standard deviations, flags."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from compute.errors import InvalidParameter
from compute.signal.centroid_settings import Weighting
from compute.signal.peaks import PeakFlag
from compute.signal.sensor_noise import SensorNoise
from compute.signal.thesis_pipeline.area_detection import WeightedAreas, areas_above
from compute.signal.thesis_pipeline.background_subtraction import (
    InterpolatedBackground,
    PeakMask,
    PolynomialBackground,
)
from compute.signal.thesis_pipeline.centroid import centre_of_gravity
from compute.signal.thesis_pipeline.filters import ButterworthFilter, FirFilter, MedianFilter
from compute.signal.thesis_pipeline.peak_separation import SlopeExtension, ValleyCut
from compute.signal.thesis_pipeline.signal_chain import SignalChain
from tests.compute.signal.thesis_pipeline.pipeline_scans import compact_peak, gaussian_lines

WEIGHTINGS: tuple[Weighting, ...] = ("edge-corrected", "above-threshold", "above-background")
DRAWS = 2000
NOISE = SensorNoise.of(1.0, 2.0)
"""One electron a count: shot noise on the light, 2 counts of read noise, rounding."""


@pytest.mark.parametrize("weighting", WEIGHTINGS)
@settings(max_examples=25, deadline=None)
@given(phase=st.floats(0.0, 1.0), sigma=st.floats(1.5, 4.0), fraction=st.floats(0.1, 0.7))
def test_the_centroids_derivative(
    weighting: Weighting, phase: float, sigma: float, fraction: float
) -> None:
    line = gaussian_lines(np.array([30.0 + phase]), sigma, 64)[0]
    top = int(line.argmax())
    found = centre_of_gravity(line, top, fraction, weighting)
    assert found.position_px == pytest.approx(30.0 + phase, abs=0.5)
    step = 1e-6 * line[top]
    for pixel in range(found.first_px - 1, found.last_px + 2):
        moved = line.copy()
        moved[pixel] += step
        again = centre_of_gravity(moved, top, fraction, weighting)
        if (again.first_px, again.last_px) == (found.first_px, found.last_px):
            change = (again.position_px - found.position_px) / step
            assert change == pytest.approx(found.derivative[pixel], rel=1e-3, abs=1e-7)


def test_the_centroid_written_out() -> None:
    """[4.1] over 3, 6, 9, 6 of maximum 9 and threshold 3: pixels above it are 6, 9, 6."""
    line = np.array([0.0, 3.0, 6.0, 9.0, 6.0, 1.0, 0.0, 0.0])
    assert centre_of_gravity(line, 3, 1 / 3, "above-threshold").position_px == 3.0
    line = np.array([0.0, 3.0, 6.0, 9.0, 8.0, 1.0, 0.0, 0.0])
    subtracted = centre_of_gravity(line, 3, 1 / 3, "above-threshold")
    assert subtracted.position_px == pytest.approx((2 * 3 + 3 * 6 + 4 * 5) / 14)
    whole = centre_of_gravity(line, 3, 1 / 3, "above-background")
    assert whole.position_px == pytest.approx((2 * 6 + 3 * 9 + 4 * 8) / 23)
    assert subtracted.width_px == pytest.approx((4 + 5 / 7) - 1.0)


CHAINS = {
    "plain": SignalChain(),
    "threshold subtracted": SignalChain.active(),
    "butterworth": SignalChain(line_filter=ButterworthFilter(4, 0.4)),
    "butterworth, delay": SignalChain(line_filter=ButterworthFilter(11, 0.4, "delay")),
    "fir": SignalChain(line_filter=FirFilter(12, 0.4)),
    "averaged": SignalChain(average=4),
    "polynomial twice": SignalChain(
        background=PolynomialBackground(3), filter_after=ButterworthFilter(4, 0.6), repeats=2
    ),
    "bridged": SignalChain(
        line_filter=FirFilter(5, 0.4),
        background=InterpolatedBackground(PeakMask(3, margin_px=5), ButterworthFilter(4, 0.4)),
    ),
    "median": SignalChain(line_filter=MedianFilter(3)),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", CHAINS)
def test_stated_standard_deviations_are_what_centroids_scatter_by(name: str) -> None:
    chain = CHAINS[name]
    lines = DRAWS * (chain.average or 1)
    ambient = 40.0 if chain.background else 0.0
    image = 4.0 * gaussian_lines(np.array([60.3]), 3.0, 128)[0] + ambient
    rng = np.random.default_rng(4)
    drawn = np.rint(rng.poisson(image, (lines, 128)) + rng.normal(0.0, 2.0, (lines, 128)))
    peaks = replace(chain, level_fraction=0.8, threshold_fraction=0.4).run(drawn, NOISE).peaks
    best = np.nanargmax(np.nan_to_num(peaks.amplitude, nan=-1.0), axis=1)
    position = peaks.position_px[np.arange(DRAWS), best]
    stated = peaks.sigma_px[np.arange(DRAWS), best]
    ratio = position.var(ddof=1) / (stated.astype(np.float64) ** 2).mean()
    # Of 2000 draws; pixels that change in and out of the run, which the derivative leaves out,
    # and the median, which is taken to pass noise unchanged, do not show beside it.
    assert abs(ratio - 1.0) < 4.0 * np.sqrt(2.0 / DRAWS)


@pytest.mark.parametrize("name", [name for name in CHAINS if name not in ("averaged", "median")])
def test_the_standard_deviation_is_that_of_the_derivative_by_every_pixel(name: str) -> None:
    """Short lines, on which the background's own noise weighs in."""
    chain = CHAINS[name]
    pixels = 48
    slope = np.linspace(20.0, 40.0, pixels) if chain.background else np.zeros(pixels)
    image = 300.0 * compact_peak(24.3, 9.0, pixels) + slope
    image += np.random.default_rng(3).normal(0.0, 0.1, pixels)
    step = 1e-4
    moved = np.concatenate([image + step * np.eye(pixels), image - step * np.eye(pixels)])
    position = chain.run(moved).peaks.position_px[:, 0].reshape(2, pixels)
    derivative = (position[0] - position[1]) / (2.0 * step)
    variance = NOISE.dark_variance[0] + np.maximum(image, 0.0)
    stated = chain.run(image, NOISE).peaks.sigma_px[0, 0]
    assert stated == pytest.approx(np.sqrt(derivative**2 @ variance), rel=1e-4)


def test_averaging_takes_the_standard_deviation_down() -> None:
    image = gaussian_lines(np.full(16, 60.3), 3.0)
    one = SignalChain().run(image, NOISE).peaks.sigma_px[0, 0]
    mean = SignalChain(average=16).run(image, NOISE).peaks.sigma_px[0, 0]
    assert mean == pytest.approx(one / 4.0, rel=1e-6)


def test_every_step_is_seen() -> None:
    smooth = ButterworthFilter(4, 0.4, "delay")
    chain = SignalChain(
        average=2,
        line_filter=smooth,
        background=PolynomialBackground(2),
        filter_after=FirFilter(5, 0.5, "delay"),
        repeats=2,
        areas=WeightedAreas(),
        separation=ValleyCut(),
    )
    image = np.repeat(gaussian_lines(np.array([40.2, 70.8]), 3.0), 2, axis=0) + 30.0
    result = chain.run(image, NOISE)
    assert [stage.name for stage in result.stages] == [
        "raw", "averaged", "filtered", *("background", "subtracted", "filtered") * 2, "weighted",
    ]  # fmt: skip
    stages = {stage.name: stage for stage in result.stages}
    assert stages["raw"].scans.shape == (4, 128)
    # Longer by 1.8 px and twice 2 px of delay, each to the next whole pixel.
    assert stages["weighted"].scans.shape == (2, 134)
    assert stages["weighted"].shift_px == pytest.approx(smooth.delay_px + 2 * 2.0)
    assert chain.correction_px == pytest.approx(smooth.delay_px + 4.0)
    assert result.peaks.count.tolist() == [1, 1]
    # A Butterworth filter's delay moved back leaves the line skewed.
    assert result.peaks.position_px[:, 0] == pytest.approx([40.2, 70.8], abs=0.1)


def test_delays_are_left_in_if_not_compensated() -> None:
    image = gaussian_lines(np.array([60.0]), 4.0)
    late = SignalChain(line_filter=FirFilter(12, 0.4, "none")).run(image)
    assert late.peaks.position_px[0, 0] == pytest.approx(65.5, abs=0.01)


def test_shape_of_the_input() -> None:
    image = gaussian_lines(np.array([60.0, 61.0]), 3.0)
    assert SignalChain().run(image[0]).peaks.position_px[0, 0] == pytest.approx(60.0, abs=0.01)
    stacked = SignalChain().run(np.stack([image, image + 1.0]))
    assert len(stacked.peaks) == 4
    assert np.isnan(stacked.peaks.sigma_px).all()


def test_flags() -> None:
    noise = SensorNoise.of(1.0, 2.0, full_scale_counts=200)
    clipped = gaussian_lines(np.array([0.5]), 3.0)
    assert SignalChain().run(clipped, noise).peaks.flags[0, 0] == PeakFlag.CLIPPED
    bright = np.minimum(4.0 * gaussian_lines(np.array([60.0]), 3.0), 200.0)
    for found in (None, ButterworthFilter(11, 0.4, "delay")):
        flags = SignalChain(line_filter=found).run(bright, noise).peaks.flags
        assert flags[0, 0] == PeakFlag.SATURATED
    close = gaussian_lines(np.array([60.0]), 2.0) + gaussian_lines(np.array([66.0]), 2.0)
    merged = SignalChain(separation=SlopeExtension(), threshold_fraction=0.0).run(close, NOISE)
    assert merged.peaks.flags[0].tolist() == [PeakFlag.MERGED] * 2


def test_a_shoulder_of_a_higher_peak_is_none_of_its_own() -> None:
    # Two areas above 4/5, one run above 1/3 of either.
    close = gaussian_lines(np.array([60.0]), 2.0) + 0.95 * gaussian_lines(np.array([66.0]), 2.0)
    assert len(areas_above(close[0], 0.8 * close.max())) == 2
    assert SignalChain(level_fraction=0.8).run(close).peaks.count[0] == 1


def test_the_passive_preset_finds_faint_peaks_on_a_bright_uneven_background() -> None:
    pixels = np.arange(512)
    ambient = 120.0 + 30.0 * np.sin(pixels / 160.0) + 20.0 * np.exp(-(((pixels - 330) / 90) ** 2))
    truth = [60.4, 180.7, 300.2, 420.9]
    light = 40.0 * sum(compact_peak(at, 7.0, 512) for at in truth)
    rng = np.random.default_rng(8)
    lines = np.rint(ambient + light + rng.normal(0.0, 1.0, (64, 512)))
    peaks = SignalChain.passive(average=64).run(lines, SensorNoise.of(1e3, 1e3)).peaks
    assert peaks.count.tolist() == [4]
    # What the bridges leave of the background's curvature moves them by hundredths.
    assert peaks.position_px[0] == pytest.approx(truth, abs=0.1)


@settings(max_examples=60, deadline=None)
@given(arrays(np.uint16, (2, 64), elements=st.integers(0, 255)))
def test_random_bits_give_no_nan(lines: np.ndarray) -> None:
    for chain in (
        SignalChain(),
        SignalChain.active(ButterworthFilter(4, 0.4)),
        SignalChain.passive(),
        SignalChain(background=PolynomialBackground(2), areas=WeightedAreas(), min_width_px=1),
    ):
        peaks = chain.run(lines, NOISE).peaks
        there = np.arange(peaks.position_px.shape[1]) < peaks.count[:, None]
        assert np.isfinite(peaks.position_px[there]).all()
        assert np.isfinite(peaks.sigma_px[there]).all()
        assert (np.diff(peaks.position_px, axis=1)[there[:, 1:]] >= 0.0).all()


def test_lines_of_one_value_have_no_peak_above_their_background() -> None:
    for level in (0.0, 77.0, 255.0):
        result = SignalChain.passive().run(np.full(128, level), NOISE)
        assert result.peaks.count.tolist() == [0]


def test_bad_settings_are_refused() -> None:
    for changes in (
        {"average": 0},
        {"repeats": 0},
        {"level_fraction": 1.0},
        {"threshold_fraction": -0.1},
        {"min_width_px": 0},
        {"weighting": "none"},
    ):
        with pytest.raises(InvalidParameter):
            SignalChain(**changes)  # type: ignore[arg-type]
