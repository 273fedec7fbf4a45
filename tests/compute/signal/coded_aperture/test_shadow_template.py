"""ShadowTemplate: woven from the optics, read between its cells, and what a coarse one costs."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from compute.errors import InvalidParameter
from compute.signal.coded_aperture.shadow_fit import ShadowFitter, ShadowSettings
from compute.signal.coded_aperture.shadow_template import (
    ShadowTemplate,
    ShiftedTemplate,
    interleave_scans,
)
from compute.signal.sensor_noise import SensorNoise
from tests.compute.signal.coded_aperture.coded_aperture_scenes import (
    PIXELS,
    shadows,
    window_optics,
    woven,
)


def bumps(cells: int, per_px: int, first_px: int = 3, dark: bool = True) -> ShadowTemplate:
    light = np.random.default_rng(cells).uniform(0.0, 1.0, cells)
    return ShadowTemplate(light, per_px, first_px, 20.0, dark)


@settings(max_examples=60)
@given(
    per_px=st.integers(1, 8),
    size=st.integers(8, 60),
    first=st.integers(-50, 50),
    shift=st.floats(-150.0, 150.0),
    dark=st.booleans(),
)
def test_whole_lines_are_those_of_single_places(per_px, size, first, shift, dark) -> None:
    template = bumps(per_px * size, per_px, first, dark)
    value, slope, known = ShiftedTemplate(template, 40).at(np.array([shift, 0.0]))
    for row, moved in enumerate((shift, 0.0)):
        place = np.arange(40.0) - moved
        one = template.at(place)
        # At its first and last cell the template jumps to dark: rounding may take either side.
        cell = (place - first) * per_px
        away = np.minimum(abs(cell), abs(cell - (per_px * size - 1))) > 1e-9
        np.testing.assert_allclose(value[row][away], one[0][away], atol=1e-9)
        np.testing.assert_allclose(slope[row][away], one[1][away], atol=1e-8)
        np.testing.assert_array_equal(known[row][away], one[2][away])


def test_it_goes_through_its_cells_and_its_slope_is_its_derivative() -> None:
    template = bumps(80, 4)
    place = 3.0 + np.arange(79) / 4.0
    np.testing.assert_allclose(template.at(place)[0], template.cells[:-1], atol=1e-12)
    inside = np.random.default_rng(1).uniform(4.0, 21.0, 50)
    step = 1e-6
    ahead, behind = template.at(inside + step)[0], template.at(inside - step)[0]
    np.testing.assert_allclose(template.at(inside)[1], (ahead - behind) / (2 * step), atol=1e-6)


def test_beyond_the_cells_it_is_dark_or_unknown() -> None:
    for dark in (True, False):
        value, slope, known = bumps(80, 4, dark=dark).at(np.array([2.9, 3.0, 22.7, 22.8, 30.0]))
        assert (value[[0, 3, 4]] == 0.0).all()
        assert (slope[[0, 3, 4]] == 0.0).all()
        assert known.tolist() == [dark, True, True, dark, dark]


def test_weaving_puts_every_pixel_where_it_belongs() -> None:
    """Shadows of a smooth pattern, in any order, some shifted far: the pattern itself."""

    def pattern(place: np.ndarray) -> np.ndarray:
        return np.sin(place / 3.0) + np.cos(place / 5.0)

    shifts = np.random.default_rng(2).permutation(
        [far - k / 4 for far in (0, -30, 30) for k in range(4)]
    )
    lines = pattern(np.arange(40.0) - shifts[:, None])
    template = interleave_scans(lines, shifts, reading_px=20.0, per_px=4, dark_beyond=False)
    assert template.first_px == -30
    # From the first pixel shifted by 30 to the last shifted by -30, with all of its phases.
    assert len(template.cells) == 4 * 100
    place = template.first_px + np.arange(len(template.cells)) / 4.0
    np.testing.assert_allclose(template.cells, pattern(place), atol=1e-12)


def test_the_optics_agree_between_the_cells() -> None:
    optics = window_optics()
    template = woven(optics, 4)
    shifts = np.array([-3.11, 0.37, 5.86])
    lines, _ = shadows(optics, shifts)
    for line, shift in zip(lines, shifts, strict=True):
        seen = template.at(np.arange(PIXELS) - shift)[0]
        assert abs(seen - line).max() < 2e-3 * template.height


def test_what_cells_as_coarse_as_pixels_cost() -> None:
    """Prints the error of noiseless shadows by the number of cells per pixel."""
    optics = window_optics()
    shifts = np.linspace(-2.0, 2.0, 41)
    lines, _ = shadows(optics, shifts)
    # So bright that rounding to counts tells nothing of the template's error.
    counts = np.rint(lines / lines.max() * 60000.0).astype(np.uint16)
    worst = {}
    for per_px in (1, 2, 4, 8):
        template = woven(optics, per_px)
        fit = ShadowFitter(
            template, PIXELS, SensorNoise.of(1.0, 10.0), ShadowSettings(misfit_probability=1e-300)
        ).fit(counts)
        worst[per_px] = float(abs(fit.shift_px - shifts).max())
        print(f"{per_px} cells per pixel: off by up to {worst[per_px]:.5f} px")
    assert worst[1] > 5.0 * worst[4]
    assert worst[4] < 3e-4
    assert worst[8] == pytest.approx(worst[4], abs=1e-4)


@pytest.mark.parametrize(
    ("make", "match"),
    [
        (lambda: ShadowTemplate(np.arange(20.0), 0, 0, 0.0, True), "per_px is 0"),
        (lambda: ShadowTemplate(np.arange(20.0), 4, 0, 0.0, True), "32 cells"),
        (lambda: ShadowTemplate(np.ones(20), 1, 0, 0.0, True), "cells are 1.0 everywhere"),
        (lambda: ShadowTemplate(np.full(20, np.nan), 1, 0, 0.0, True), "not finite"),
        (
            lambda: interleave_scans(
                np.ones((2, 9)), [0.0], reading_px=0, per_px=1, dark_beyond=True
            ),
            r"\(2, 9\) and \(1,\)",
        ),
        (
            lambda: interleave_scans(
                np.ones((1, 9)), [0.3], reading_px=0, per_px=2, dark_beyond=True
            ),
            "shift_px is 0.3",
        ),
        (
            lambda: interleave_scans(
                np.ones((1, 9)), [0.0], reading_px=0, per_px=2, dark_beyond=True
            ),
            "holes",
        ),
    ],
)
def test_what_is_refused(make, match: str) -> None:
    with pytest.raises(InvalidParameter, match=match):
        make()
