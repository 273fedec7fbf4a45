"""Noise guessed from lines, and the height from which a maximum is a peak."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from compute.signal.centroid_reference import find_peaks_reference, scan_background
from compute.signal.centroid_settings import (
    GROUP_PIXELS,
    LEVEL_UNIT,
    CentroidSettings,
    sample_starts,
)
from compute.signal.detection.background_estimate import estimate_background
from service.api.line_scans.noise import estimate_noise, line_noise, noise_at, search_limits
from service.api.line_scans.schema import PixelNoise
from tests.compute.signal.synthetic_scans import varied_lines


@pytest.mark.parametrize("gain", [1.5, 20.0])
def test_the_gain_of_a_photon_limited_line_is_found(gain: float) -> None:
    """The variance of one line has a standard error of 14 %; its median over 64 lines 1.25 / 8."""
    rng = np.random.default_rng(5)
    lines = np.rint(rng.poisson(200.0 * gain, (64, 2048)) / gain).astype(np.uint16)
    noise, assumed = estimate_noise(lines)
    assert noise.electrons_per_count == pytest.approx(gain, rel=5.0 * 0.14 * 1.25 / 8.0)
    assert noise.read_noise_electrons == 0.0
    assert noise.offset_counts == 0.0
    assert [text.partition(":")[0] for text in assumed] == [
        "noise of a pixel at the background", "gain", "read noise", "offset", "full scale",
        "standard deviations are lower limits",
    ]  # fmt: skip


@given(st.integers(0, 2**32 - 1), st.sampled_from([64, 200, 1024]))
@settings(max_examples=60, deadline=None)
def test_guessed_noise_is_what_was_measured(seed: int, pixels: int) -> None:
    lines = varied_lines(8, pixels, np.random.default_rng(seed))
    noise, _ = estimate_noise(lines)
    spread = estimate_background(lines)
    background = np.array([np.median(spread.background) / LEVEL_UNIT])
    assert noise_at(noise, background)[0] ** 2 == pytest.approx(np.median(spread.variance()))
    assert noise.electrons_per_count >= 1.0
    assert noise.full_scale_counts >= lines.max()
    assert noise.full_scale_counts < 2 * max(int(lines.max()), 128)


@given(
    st.integers(0, 2**32 - 1),
    st.floats(3.0, 30.0),
    st.floats(0.5, 50.0),
    st.floats(0.0, 100.0),
    st.integers(0, 400),
    st.floats(0.0, 30.0),
)
@settings(max_examples=100, deadline=None)
def test_a_peak_reaches_the_limit(
    seed: int, sigma: float, gain: float, read: float, offset: int, ripple: float
) -> None:
    """A pixel at the limit is a peak; one a count below is none."""
    rng = np.random.default_rng(seed)
    search = CentroidSettings(detection_sigma=sigma, min_width_px=1, max_peaks=1024)
    noise = PixelNoise(electrons_per_count=gain, read_noise_electrons=read, offset_counts=offset)
    sampled = np.array(sample_starts(1024))[:, None] + np.arange(GROUP_PIXELS)
    lines = np.full((1, 1024), 300, np.uint16)
    lines[0, sampled] = np.rint(500.0 + ripple * rng.uniform(-1.0, 1.0, sampled.shape))
    # A pixel that the background is not taken from, nor its neighbours.
    dark = np.setdiff1d(np.arange(1024), sampled)
    place = int(dark[(np.diff(dark, prepend=-9) == 1) & (np.diff(dark, append=9999) == 1)][20])
    assume(scan_background(lines[0].astype(np.int64))[2] == 0)  # a slope moves it at the place
    limit = search_limits(lines, search, noise)[0]
    assume(limit < 65000 and abs(limit - round(limit)) > 1e-6)
    for height, peak in ((np.ceil(limit), True), (np.ceil(limit) - 1, False)):
        lines[0, place] = height
        found = find_peaks_reference(lines, search, line_noise(noise))
        assert (np.abs(found.position_px[0] - place) < 0.5).any() == peak
