"""Decoding by cross-correlation, on patterns whose shift is known."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from compute.errors import InvalidParameter
from compute.optics.coded_aperture.coded_window import maximal_length_code
from compute.optics.coded_aperture.correlation_decoding import decode_mask

CODE = np.repeat(np.array(maximal_length_code(6), dtype=np.float64), 9)


def placed(shift: int, length: int = 1500) -> np.ndarray:
    line = np.zeros(length)
    line[shift : shift + CODE.size] = CODE
    return line


@settings(max_examples=40, deadline=None)
@given(shift=st.integers(-20, 1450 - CODE.size), gain=st.floats(1.0, 1e6), offset=st.floats(0, 1e5))
def test_the_shift_is_found_whatever_the_light(shift: int, gain: float, offset: float) -> None:
    found = decode_mask(offset + gain * placed(30 + shift), placed(30))
    assert float(found.shift_px) == pytest.approx(shift, abs=1e-5)
    assert float(found.peak) == pytest.approx(1.0, abs=0.05)
    assert float(found.second_ratio) < 0.5


def test_a_template_may_come_from_the_right() -> None:
    assert float(decode_mask(placed(200), placed(700)).shift_px) == pytest.approx(-500.0, abs=0.01)


def test_a_template_may_be_longer_than_the_line() -> None:
    found = decode_mask(placed(300)[150:1100], placed(400))
    assert float(found.shift_px) == pytest.approx(300 - 150 - 400, abs=0.02)


def test_it_is_the_sum_of_the_thesis() -> None:
    """[2.16] as it stands, for shifts from 0 on, of a line without its mean."""
    rng = np.random.default_rng(2)
    model = rng.normal(size=40)
    line = np.roll(model, 7) + 0.2 * rng.normal(size=40)
    x, y = model, line - line.mean()
    direct = np.array([x[: 40 - m] @ y[m:] for m in range(40)])
    best = int(direct.argmax())
    before, at, after = direct[best - 1 : best + 2]
    part = 0.5 * (before - after) / (before - 2 * at + after)
    found = decode_mask(line, model)
    assert float(found.shift_px) == pytest.approx(best + part, abs=1e-9)
    height = (at - 0.25 * (before - after) * part) / (40 * np.sqrt(x.var() * y.var()))
    assert float(found.peak) == pytest.approx(height, abs=1e-9)


@settings(max_examples=40, deadline=None)
@given(shift=st.floats(100.0, 130.0), width=st.floats(3.0, 20.0))
def test_a_smooth_peak_is_found_between_pixels(shift: float, width: float) -> None:
    place = np.arange(400)
    template = np.exp(-((place - 80.0) ** 2) / (2 * width**2))
    line = np.exp(-((place - 80.0 - shift) ** 2) / (2 * width**2))
    found = decode_mask(line, template)
    # The parabola through a Gaussian of sqrt(2) width.
    assert float(found.shift_px) == pytest.approx(shift, abs=0.05 / width**2)


def test_two_equal_patterns_are_told_as_ambiguous() -> None:
    line = placed(0, 2000) + np.roll(placed(0, 2000), 1100)
    assert float(decode_mask(line, placed(0)).second_ratio) > 0.9


def test_lines_come_back_in_their_shape() -> None:
    lines = np.array([[placed(3), placed(50)], [placed(401), placed(777)]])
    found = decode_mask(lines, placed(0))
    np.testing.assert_allclose(found.shift_px, [[3, 50], [401, 777]], atol=0.01)
    assert found.peak.shape == found.second_ratio.shape == (2, 2)


def test_a_dark_line_has_no_peak() -> None:
    found = decode_mask(np.full(900, 7.0), placed(0))
    assert float(found.peak) == 0.0
    assert float(found.second_ratio) == 1.0


@pytest.mark.parametrize(
    ("lines", "template", "match"),
    [
        (np.zeros(9), np.zeros(2), "template has the shape"),
        (np.zeros(9), np.eye(4), "template has the shape"),
        (np.zeros(2), np.arange(4.0), "scans have the shape"),
        (np.zeros(9), np.ones(4), "it must have contrast"),
        (np.full(9, np.nan), np.arange(4.0), "not finite"),
        (np.zeros(9), np.array([0.0, np.inf, 1.0]), "not finite"),
    ],
)
def test_what_cannot_be_correlated_is_refused(
    lines: np.ndarray, template: np.ndarray, match: str
) -> None:
    with pytest.raises(InvalidParameter, match=match):
        decode_mask(lines, template)
