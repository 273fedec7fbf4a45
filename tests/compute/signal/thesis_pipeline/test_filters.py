"""Filters of the chain: linear, unit gain, their delays exact, and their phase removed."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import group_delay

from compute.errors import InvalidParameter, NonFiniteValue
from compute.signal.centroid_settings import Weighting
from compute.signal.thesis_pipeline.filters import ButterworthFilter, FirFilter, MedianFilter
from compute.signal.thesis_pipeline.signal_chain import SignalChain
from compute.signal.thesis_pipeline.steps import Compensation, ScanFilter
from tests.compute.signal.thesis_pipeline.pipeline_scans import gaussian_lines, whole_centre

COMPENSATIONS: tuple[Compensation, ...] = ("none", "delay", "phase")
TABLE_C = [
    make(order, cutoff)  # type: ignore[operator]
    for make, order in (
        (ButterworthFilter, 4),
        (ButterworthFilter, 11),
        (FirFilter, 5),
        (FirFilter, 12),
    )
    for cutoff in (0.6, 0.4)
]
MEDIANS = [MedianFilter(aperture) for aperture in (3, 4, 7, 8)]
THESIS_SIGMA_PX = (20.0 / 6.0, 22.5 / 6.0, 25.0 / 6.0)
"""Of lines 20 to 25 px wide at the base, section 4.1."""

orders = st.integers(1, 20)
cutoffs = st.floats(0.1, 0.9)
compensations = st.sampled_from(COMPENSATIONS)
linear = st.one_of(
    st.builds(ButterworthFilter, orders, cutoffs, compensations),
    st.builds(FirFilter, st.integers(2, 40), cutoffs, compensations),
)
medians = st.builds(MedianFilter, st.integers(1, 12))
seeds = st.integers(0, 2**32 - 1)


def noise_lines(seed: int, lines: int = 3, pixels: int = 100) -> np.ndarray:
    return np.random.default_rng(seed).normal(50.0, 20.0, (lines, pixels))


@settings(max_examples=40, deadline=None)
@given(linear, seeds, st.floats(-3.0, 3.0))
def test_linear_filters_are_linear(found: ScanFilter, seed: int, factor: float) -> None:
    a, b = noise_lines(seed, 2)
    together = found.apply(a + factor * b)
    np.testing.assert_allclose(together, found.apply(a) + factor * found.apply(b), atol=1e-9)


@settings(max_examples=40, deadline=None)
@given(st.one_of(linear, medians), st.floats(-1e4, 1e4), st.integers(8, 300))
def test_a_constant_line_is_unchanged(found: ScanFilter, level: float, pixels: int) -> None:
    line = np.full(pixels, level)
    np.testing.assert_allclose(found.apply(line), line, rtol=1e-9, atol=1e-9)


@settings(max_examples=40, deadline=None)
@given(st.one_of(linear, medians), seeds)
def test_a_batch_is_filtered_as_its_lines_are(found: ScanFilter, seed: int) -> None:
    lines = noise_lines(seed, 6).reshape(2, 3, -1)
    one_by_one = np.array([[found.apply(line) for line in row] for row in lines])
    np.testing.assert_allclose(found.apply(lines), one_by_one, rtol=1e-12, atol=1e-9)


@settings(max_examples=30, deadline=None)
@given(st.one_of(linear, medians), st.integers(1, 40))
def test_a_shifted_line_is_shifted_after_the_filter(found: ScanFilter, shift: int) -> None:
    # In the middle of a line so long that the filter's answer ends before the line does.
    line = gaussian_lines(np.array([400.0]), 3.0, 1024)[0]
    shifted = found.apply(np.roll(line, shift))
    np.testing.assert_allclose(shifted, np.roll(found.apply(line), shift), atol=1e-3)


@settings(max_examples=40, deadline=None)
@given(linear, seeds)
def test_the_adjoint_is_the_transposed_filter(found: ScanFilter, seed: int) -> None:
    line, weights = noise_lines(seed, 2, 60)
    assert weights @ found.apply(line) == pytest.approx(found.adjoint(weights) @ line, rel=1e-8)


@settings(max_examples=40, deadline=None)
@given(orders, cutoffs)
def test_a_butterworth_filter_moves_a_line_by_its_delay_at_zero_frequency(
    order: int, cutoff: float
) -> None:
    found = ButterworthFilter(order, cutoff, "none")
    line = gaussian_lines(np.array([1000.3]), 4.0, 4096)
    moved = whole_centre(found.apply(line))[0] - 1000.3
    assert moved == pytest.approx(found.delay_px, abs=1e-6)
    assert found.shift_px == found.delay_px
    assert ButterworthFilter(order, cutoff, "delay").correction_px == found.delay_px
    assert found.correction_px == 0.0


@settings(max_examples=20, deadline=None)
@given(st.integers(2, 60), cutoffs)
def test_a_fir_filter_has_the_delay_of_b_8_at_all_frequencies(taps: int, cutoff: float) -> None:
    found = FirFilter(taps, cutoff, "none")
    assert found.delay_px == (taps - 1) / 2
    frequencies = np.pi * cutoff * np.array([0.1, 0.5, 0.9])
    impulse = np.zeros(256)
    impulse[100] = 1.0
    kernel = found.apply(impulse)[100 : 100 + taps]
    np.testing.assert_allclose(
        group_delay((kernel, [1.0]), frequencies)[1], found.delay_px, atol=1e-6
    )
    spectrum = np.exp(-1j * np.outer(frequencies, np.arange(taps))) @ kernel
    response = found.amplitude(frequencies) * np.exp(-1j * frequencies * found.delay_px)
    np.testing.assert_allclose(response, spectrum, atol=1e-12)


def test_the_delays_beside_the_published_ones() -> None:
    """Table C's columns moved by 0.95 to 5.1 px."""
    four = [ButterworthFilter(order, fc) for order in (4, 11) for fc in (0.6, 0.4)]
    assert [one.delay_px for one in four] == pytest.approx([0.949, 1.798, 2.553, 4.836], abs=1e-3)
    assert FirFilter(5, 0.4).delay_px == 2.0
    assert FirFilter(12, 0.4).delay_px == 5.5


@settings(max_examples=20, deadline=None)
@given(orders, cutoffs)
def test_without_its_phase_a_filter_has_the_same_magnitude(order: int, cutoff: float) -> None:
    """|H| once, not its square: the spectrum of an impulse's answer."""
    pixels = 2048
    impulse = np.zeros(pixels)
    impulse[pixels // 2] = 1.0
    answer = np.abs(np.fft.rfft(ButterworthFilter(order, cutoff).apply(impulse)))
    omega = 2.0 * np.pi * np.fft.rfftfreq(pixels)
    expected = np.abs(ButterworthFilter(order, cutoff).response(omega))
    # The answer ends with the scan, which rounds corners of the magnitude: the sharpest, at half
    # the sampling rate of a first order, by 1/pi of a frequency's step.
    step = np.abs(np.diff(expected)).max()
    np.testing.assert_allclose(answer, expected, atol=1.01 * step / np.pi)
    at_cutoff = ButterworthFilter(order, cutoff).magnitude(np.array([np.pi * cutoff]))
    assert at_cutoff[0] == pytest.approx(np.sqrt(0.5))


@pytest.mark.parametrize("found", TABLE_C, ids=str)
@pytest.mark.parametrize("sigma_px", [1.0, 2.0, *THESIS_SIGMA_PX])
def test_without_its_phase_no_filter_of_table_c_moves_a_whole_line(
    found: ScanFilter, sigma_px: float
) -> None:
    # So long that the answer ends before the line, whose mirror image would weigh in.
    lines = gaussian_lines(512.0 + np.linspace(0.0, 1.0, 21), sigma_px, 1024)
    moved = whole_centre(found.apply(lines)) - whole_centre(lines)
    assert np.abs(moved).max() < 1e-9


@pytest.mark.parametrize("sigma_px", THESIS_SIGMA_PX)
@pytest.mark.parametrize("found", TABLE_C, ids=str)
def test_without_its_phase_no_filter_of_table_c_moves_a_centroid(
    found: ScanFilter, sigma_px: float
) -> None:
    """[4.1] over a third of the maximum, edge-corrected: at most 0.01 px."""
    assert _moved(found, sigma_px, "edge-corrected") < 0.01


@pytest.mark.parametrize("found", MEDIANS, ids=str)
@pytest.mark.parametrize("sigma_px", THESIS_SIGMA_PX)
def test_medians_move_no_whole_line_by_more_than_a_hundredth(
    found: ScanFilter, sigma_px: float
) -> None:
    """They flatten the top by sorting: a threshold on it adds [4.1]'s own errors to this."""
    lines = gaussian_lines(64.0 + np.linspace(0.0, 1.0, 21), sigma_px)
    moved = whole_centre(found.apply(lines)) - found.correction_px - whole_centre(lines)
    assert np.abs(moved).max() < 0.01
    assert _moved(found, sigma_px, "edge-corrected") < 0.02


def test_moving_back_by_the_delay_leaves_what_the_skew_does() -> None:
    """Thesis 4.2.2's way: the phase is no line, and a centroid over a threshold notices."""
    late = ButterworthFilter(11, 0.4, "delay")
    assert 0.05 < _moved(late, 3.75, "edge-corrected") < 0.15
    assert _moved(FirFilter(12, 0.4, "delay"), 3.75, "edge-corrected") < 0.01


def _moved(found: ScanFilter, sigma_px: float, weighting: Weighting) -> float:
    lines = gaussian_lines(64.0 + np.linspace(0.0, 1.0, 21), sigma_px)
    plain = SignalChain(weighting=weighting).run(lines).peaks
    filtered = SignalChain(line_filter=found, weighting=weighting).run(lines).peaks
    assert (plain.count == 1).all()
    assert (filtered.count == 1).all()
    return float(np.abs(filtered.position_px - plain.position_px).max())


@settings(max_examples=30, deadline=None)
@given(st.integers(1, 15), seeds)
def test_a_median_is_the_middle_of_its_window(aperture: int, seed: int) -> None:
    line = noise_lines(seed, 1, 40)[0]
    padded = np.pad(line, aperture, mode="edge")
    filtered = MedianFilter(aperture).apply(line)
    for pixel in range(40):
        first = pixel + aperture - aperture // 2
        assert filtered[pixel] == pytest.approx(np.median(padded[first : first + aperture]))


@pytest.mark.parametrize(("aperture", "shift"), [(3, 0.0), (4, 0.5), (7, 0.0), (8, 0.5)])
def test_an_even_aperture_moves_lines_by_half_a_pixel(aperture: int, shift: float) -> None:
    found = MedianFilter(aperture)
    ramp = np.arange(50.0)
    np.testing.assert_allclose(found.apply(ramp)[10:40], ramp[10:40] - shift)
    assert found.correction_px == found.shift_px == shift
    assert MedianFilter(aperture, "none").correction_px == 0.0


@pytest.mark.parametrize(
    "make",
    [
        lambda: MedianFilter(0),
        lambda: MedianFilter(3, "phase"),
        lambda: ButterworthFilter(0, 0.5),
        lambda: ButterworthFilter(4, 1.0),
        lambda: ButterworthFilter(4, float("nan")),
        lambda: ButterworthFilter(4, 0.5, "filtfilt"),  # type: ignore[arg-type]
        lambda: FirFilter(1, 0.5),
        lambda: FirFilter(5, 0.0),
        lambda: FirFilter(5, 0.5).apply(np.zeros(4)),
    ],
)
def test_bad_filters_are_refused(make: object) -> None:
    with pytest.raises(InvalidParameter):
        make()  # type: ignore[operator]


def test_values_that_are_no_numbers_are_refused() -> None:
    with pytest.raises(NonFiniteValue):
        MedianFilter(3).apply([0.0] * 9 + [float("nan")])


@pytest.mark.parametrize("order", [1, 30, 64])
@pytest.mark.parametrize("cutoff", [0.02, 0.5, 0.98])
@pytest.mark.parametrize("compensation", COMPENSATIONS)
def test_high_orders_stay_stable(order: int, cutoff: float, compensation: Compensation) -> None:
    lines = noise_lines(1, 2, 2000)
    filtered = ButterworthFilter(order, cutoff, compensation).apply(lines)
    assert np.abs(filtered).max() < 3.0 * np.abs(lines).max()
