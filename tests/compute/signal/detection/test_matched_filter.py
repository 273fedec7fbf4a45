"""MatchedFilter: whole numbers, blind to background, and as good as its theory says."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from compute.errors import InvalidParameter
from compute.signal.detection.matched_filter import (
    MAX_ABSOLUTE_SUM,
    MatchedFilter,
    gaussian_filter,
    gaussian_shape,
    shape_filter,
)


def ramps(rows: np.ndarray) -> np.ndarray:
    """First moments about the first pixel."""
    return rows @ np.arange(rows.shape[1])


def shapes() -> st.SearchStrategy[np.ndarray]:
    """Skew bells: darker at both ends, of any odd length."""

    def bell(half: int, width: float, skew: float) -> np.ndarray:
        k = np.arange(-half, half + 1) / (half * width)
        return np.exp(-0.5 * k**2) * (1.0 + skew * np.tanh(3.0 * k))

    return st.builds(bell, st.integers(4, 60), st.floats(0.15, 0.4), st.floats(-0.9, 0.9))


@settings(max_examples=40)
@given(shape=shapes(), slope=st.booleans())
def test_taps_are_exactly_blind_to_the_background(shape: np.ndarray, slope: bool) -> None:
    matched = shape_filter(shape, slope=slope)
    rows = matched.matrix(2 * len(shape) + 3)
    assert (rows.sum(axis=1) == 0).all()
    assert (abs(rows).sum(axis=1) <= MAX_ABSOLUTE_SUM).all()
    if slope:
        assert (ramps(rows) == 0).all()
    # One threshold serves all places: of one norm, with each tap off by 1 or 2 at most.
    norms = np.sqrt((rows.astype(np.float64) ** 2).sum(axis=1))
    np.testing.assert_allclose(norms, matched.norm, rtol=0, atol=1.5 * np.sqrt(len(shape)))


@settings(max_examples=30)
@given(width=st.floats(0.3, 20.0))
def test_a_gaussian_filter_is_symmetric_and_blind_to_slopes_inside(width: float) -> None:
    matched = gaussian_filter(width)
    np.testing.assert_array_equal(matched.taps, matched.taps[::-1])
    assert matched.taps @ np.arange(len(matched.taps)) == 0
    np.testing.assert_array_equal(matched.right, matched.left[:, ::-1])
    # A running sum and a core no longer than the line, both within 32 bits.
    core = matched.taps + matched.level
    assert abs(np.flatnonzero(core) - matched.half_px).max() <= np.ceil(6.0 * width) + 1
    assert (core >= 0).all()
    assert core.sum() * 65535 < 2**31
    assert core.sum() == matched.level * len(core)


@pytest.mark.parametrize("width", [0.6, 2.0, 6.0])
def test_answers_are_those_of_the_matrix_and_fit_32_bits(width: float) -> None:
    matched = gaussian_filter(width)
    rng = np.random.default_rng(1)
    lines = rng.integers(0, 65536, (20, 300)).astype(np.uint16)
    # The worst that pixels can do to the taps of one place.
    lines[0] = np.where(matched.matrix(300)[150] > 0, 65535, 0)
    lines[1] = np.where(matched.matrix(300)[0] > 0, 65535, 0)
    answer = matched.respond(lines)
    np.testing.assert_array_equal(answer, lines.astype(np.int64) @ matched.matrix(300).T)
    assert abs(answer).max() < 2**31
    assert not matched.respond(np.full((1, 300), 65535, np.uint16)).any()


def test_the_signal_to_noise_ratio_that_the_background_costs() -> None:
    """Prints efficiencies by length, and the gain over single pixels, over sub-pixel phases."""
    phases = np.linspace(-0.5, 0.5, 21)
    for width in (0.6, 1.0, 2.0, 3.0):
        print(f"width {width} px: ", end="")
        for widths in (8, 12, 16, 20):
            matched = gaussian_filter(width, 2 * int(np.ceil(widths * width / 2)) + 1)
            # What a constant takes away: the shape's mean.
            shape = gaussian_shape(width, matched.half_px)
            share = shape.sum() ** 2 / (len(shape) * (shape**2).sum())
            assert matched.efficiency == pytest.approx(np.sqrt(1.0 - share), abs=1e-4)
            print(f"{widths} widths {matched.efficiency:.3f}, ", end="")
        matched = gaussian_filter(width)
        peaks = [gaussian_shape(width, matched.half_px, phase) for phase in phases]
        answer = [matched.taps @ peak / matched.norm for peak in peaks]
        gain = np.array(answer) / [peak.max() for peak in peaks]
        whole = np.array(answer) / [np.sqrt((peak**2).sum()) for peak in peaks]
        print(f"gain over the highest pixel {gain.min():.2f} to {gain.max():.2f}, ", end="")
        print(f"of the ideal {whole.min():.3f} to {whole.max():.3f}")
        assert gain[10] == pytest.approx(matched.snr_of_pixel_snr, rel=1e-4)
        assert (whole < 1.0).all()
        # For lines of 1 px and more it is worth it at every phase.
        if width >= 1.0:
            assert (gain > 1.15).all()


def test_it_beats_any_other_filter_that_is_blind_to_a_constant() -> None:
    matched = gaussian_filter(2.0)
    best = matched.snr_of_pixel_snr
    rng = np.random.default_rng(2)
    for _ in range(200):
        other = matched.taps + rng.normal(0.0, 0.05 * matched.norm, len(matched.taps))
        other -= other.mean()
        assert other @ matched.shape / np.sqrt(other @ other) < best


def test_gains_near_the_ends_are_of_peaks_that_the_end_cuts() -> None:
    matched = gaussian_filter(2.0)
    pixels = 90
    gains = matched.gains(pixels)
    rows = matched.matrix(pixels)
    for place in (0, 1, 5, 15, 16, 40, 73, 74, 88, 89):
        line = np.zeros(pixels)
        first = place - matched.half_px
        for k, value in enumerate(matched.shape):
            if 0 <= first + k < pixels:
                line[first + k] = value
        assert gains[place] == pytest.approx(rows[place] @ line, rel=1e-12)
    # Half of a peak in sight: less than the whole, more than half.
    assert 0.7 < gains[0] / gains[45] < 0.9


@pytest.mark.parametrize(
    ("make", "match"),
    [
        (lambda: gaussian_filter(0.1), "width_px is 0.1"),
        (lambda: gaussian_filter(float("nan")), "width_px is nan"),
        (lambda: gaussian_filter(2.0, 32), "length_px is 32"),
        (lambda: gaussian_filter(2.0, 7), "length_px is 7; .* 9"),
        (lambda: shape_filter(np.ones(6)), r"\(6,\)"),
        (lambda: shape_filter(np.ones(3)), r"\(3,\)"),
        (lambda: shape_filter(np.ones((3, 3))), r"\(3, 3\)"),
        (lambda: shape_filter(np.ones(9)), "cannot be told from background"),
        (lambda: shape_filter(np.arange(9.0), slope=True), "cannot be told"),
        (lambda: shape_filter([0, 1, -1, 1, 0]), "holds -1.0"),
        (lambda: shape_filter([0, 1, np.nan, 1, 0]), "finite"),
        (lambda: gaussian_filter(2.0).respond(np.zeros((1, 32), np.uint16)), "33 or more"),
    ],
)
def test_what_is_refused(make, match: str) -> None:
    with pytest.raises(InvalidParameter, match=match):
        make()


def test_types() -> None:
    assert isinstance(gaussian_filter(1.0), MatchedFilter)
    assert gaussian_filter(1.0).taps.dtype == np.int64
