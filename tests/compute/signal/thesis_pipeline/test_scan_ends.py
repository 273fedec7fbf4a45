"""The ends of lines and of filters: nothing vanishes, nothing is made up, doubt is flagged."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from compute.errors import InvalidParameter
from compute.signal.peaks import PeakFlag
from compute.signal.sensor_noise import SensorNoise
from compute.signal.thesis_pipeline.background_subtraction import PolynomialBackground
from compute.signal.thesis_pipeline.filters import ButterworthFilter, FirFilter, MedianFilter
from compute.signal.thesis_pipeline.signal_chain import SignalChain
from compute.signal.thesis_pipeline.steps import ScanFilter
from tests.compute.signal.thesis_pipeline.pipeline_scans import compact_peak, gaussian_lines

PIXELS = 128
NOISE = SensorNoise.of(1.0, 2.0)
DELAYS: list[ScanFilter] = [
    FirFilter(31, 0.5, "delay"),
    ButterworthFilter(4, 0.4, "delay"),
    MedianFilter(4),
]


@pytest.mark.parametrize("line_filter", DELAYS, ids=["fir", "butterworth", "median"])
@settings(max_examples=25, deadline=None)
@given(st.floats(7.0, PIXELS - 8.0))
def test_a_peak_near_an_end_stays_where_it_is(line_filter: ScanFilter, place: float) -> None:
    """As far from the ends as it is in the middle of a longer line."""
    chain = SignalChain(line_filter=line_filter, level_fraction=0.5)
    far = 256
    short = chain.run(1000.0 * compact_peak(place, 7.0, PIXELS), NOISE).peaks
    middle = chain.run(1000.0 * compact_peak(place + far, 7.0, PIXELS + 2 * far), NOISE).peaks
    assert short.count[0] == middle.count[0] == 1
    expected = middle.position_px[0, 0] - far
    assert short.position_px[0, 0] == pytest.approx(expected, abs=1e-6)
    # Its noise at the ends is that of the last pixels, which go on beyond them.
    assert np.isfinite(short.sigma_px[0, 0])


def test_after_the_background_nothing_vanishes_either() -> None:
    late = FirFilter(21, 0.5, "delay")
    chain = SignalChain(
        line_filter=late, background=PolynomialBackground(0), filter_after=late, repeats=2
    )
    image = 1000.0 * compact_peak(PIXELS - 12.0, 7.0, PIXELS) + 50.0
    peaks = chain.run(image, NOISE).peaks
    assert peaks.position_px[0, : peaks.count[0]] == pytest.approx([PIXELS - 12.0], abs=0.05)
    assert peaks.flags[0, 0] & PeakFlag.CLIPPED


@pytest.mark.parametrize("compensation", ["delay", "phase"])
def test_what_lies_beyond_an_end_weighs_in_as_far_as_a_filter_reaches(compensation: str) -> None:
    fir = FirFilter(21, 0.5, compensation)  # type: ignore[arg-type]
    chain = SignalChain(line_filter=fir, level_fraction=0.5)
    assert chain.reach_px == 10.0
    for place, clipped in ((13.0, True), (25.0, False), (PIXELS - 14.0, True), (102.0, False)):
        found = chain.run(gaussian_lines(np.array([place]), 2.0), NOISE).peaks
        assert bool(found.flags[0, 0] & PeakFlag.CLIPPED) is clipped


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from(range(len(DELAYS))))
def test_no_position_is_off_the_line(seed: int, number: int) -> None:
    lines = np.random.default_rng(seed).integers(0, 1000, (2, 64))
    chain = SignalChain(line_filter=DELAYS[number], level_fraction=0.0, min_width_px=1)
    for noise in (None, NOISE):
        peaks = chain.run(lines, noise).peaks
        there = peaks.position_px[~np.isnan(peaks.position_px)]
        assert ((there >= -0.5) & (there <= 63.5)).all()


def test_a_chain_that_delays_by_a_whole_line_is_refused() -> None:
    chain = SignalChain(line_filter=FirFilter(129, 0.5, "delay"))
    with pytest.raises(InvalidParameter, match="64 px"):
        chain.run(np.zeros(64))
    assert chain.run(np.zeros(65)).peaks.count[0] == 0


def test_what_is_less_sure_than_it_is_wide_is_no_peak() -> None:
    level = np.full(PIXELS, 4095.0)
    chain = SignalChain(background=PolynomialBackground(0))
    assert chain.run(level, NOISE).peaks.count[0] == 0
    light = level + gaussian_lines(np.array([60.0]), 3.0)[0]
    assert chain.run(light, NOISE).peaks.count[0] == 1
    found = chain.run(
        np.random.default_rng(1).normal(100.0, 2.0, (20, PIXELS)), SensorNoise.of(1.0, 1e3)
    )
    assert found.peaks.count.sum() == 0


def test_of_more_peaks_the_highest_are_kept() -> None:
    heights = np.random.default_rng(2).permutation(np.arange(10, 22)) * 10.0
    line = np.zeros(256)
    line[10:250:20] = heights
    line = np.convolve(line, [0.5, 1.0, 0.5], mode="same")
    found = SignalChain(level_fraction=0.0, max_peaks=5).run(line).peaks
    kept = np.sort(np.argsort(heights)[-5:])
    assert found.position_px[0] == pytest.approx(10.0 + 20.0 * kept)
    assert (found.flags[0] == PeakFlag.TRUNCATED).all()
    whole = SignalChain(level_fraction=0.0, max_peaks=12).run(line).peaks
    assert whole.count[0] == 12
    assert not (whole.flags & PeakFlag.TRUNCATED).any()
