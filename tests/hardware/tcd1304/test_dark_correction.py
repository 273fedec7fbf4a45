"""Dark correction: counts increase with light, above the scan's dark level."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from hardware.tcd1304.response import OFFSET_COUNTS, dark_corrected_counts, dark_level
from tests.hardware.tcd1304.simulated_board import response_counts


@given(st.integers(0, 3647), st.integers(1, 2000), st.integers(2100, 4000))
def test_a_line_of_light_stands_at_its_pixel(pixel: int, light: int, dark: int) -> None:
    shape = np.zeros(3648)
    shape[pixel] = light
    lines = dark_corrected_counts(response_counts(shape, dark), 0)
    assert lines.shape == (3648,)
    assert lines.dtype == np.uint16
    assert lines[pixel] == OFFSET_COUNTS + light
    assert (np.delete(lines, pixel) == OFFSET_COUNTS).all()


def test_the_dark_level_is_that_of_the_shielded_pixels() -> None:
    """Light on the pixels, and whatever the other dummy elements show, do not count."""
    counts = response_counts(np.full(3648, 1000.0), 3000)
    counts[:16], counts[29:32], counts[-14:] = 17, 18, 19
    assert dark_level(counts) == 3000.0
    counts[16] = 3013
    assert dark_level(counts) == 3001.0


def test_full_pixels_are_at_full_scale_and_others_are_not() -> None:
    shape = np.zeros(3648)
    shape[100], shape[101], shape[102] = 2399, 2400, 2401
    lines = dark_corrected_counts(response_counts(shape, 3000), 600)
    assert lines[100] == OFFSET_COUNTS + 2399
    assert lines[101] == lines[102] == 4095


def test_noise_below_the_dark_level_is_kept() -> None:
    """With the offset, noise of 5 counts is not cut off at zero: its mean stays."""
    lines = dark_corrected_counts(
        response_counts(np.zeros(3648), 3000, noise_counts=5.0, seed=3), 0
    )
    assert abs(lines.mean() - OFFSET_COUNTS) < 5.0
    assert 4.5 < lines.std() < 5.5
