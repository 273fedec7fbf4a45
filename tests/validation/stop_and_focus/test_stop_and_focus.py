"""Case stop-and-focus: the figures of lines, and what its recommendation rests on."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import ndtr

from compute.optics.stripe_optics.stripe_profile import CELLS, StripeProfiles
from validation.aberrations.thesis_lens import WIDTH_MM, StopPlace, stopped_lens
from validation.all_cases import ALL_CASES
from validation.result_tables import TablesCase
from validation.skew_effect.traced_readings import FIELD_U
from validation.stop_and_focus.case import FIELD
from validation.stop_and_focus.stripe_quality import (
    ELECTRONS_PER_SR,
    NEAREST_MM,
    best_focus_mm,
    coma_free_stop_mm,
    gravity_error,
    line_bound,
    line_figures,
    root_mean_square,
)

pytestmark = pytest.mark.slow  # published figures, ray by ray


def gaussian_line(sigma_px: float, position_px: float, electrons: float) -> StripeProfiles:
    edges = -0.5 + np.arange(64 * CELLS + 1) / CELLS
    cells = np.diff(ndtr((edges - 32.0 - position_px) / sigma_px))
    return StripeProfiles(np.zeros(1, np.int64), cells[None] * electrons / ELECTRONS_PER_SR)


@given(sigma=st.floats(1.2, 4.0), place=st.floats(-0.5, 0.5))
def test_bound_of_a_bright_gaussian_is_sigma_by_the_root_of_its_electrons(
    sigma: float, place: float
) -> None:
    electrons = 1e9
    bound = float(line_bound(gaussian_line(sigma, place, electrons), 0.0)[0])
    # Pixels of width 1 add 1/12 to the variance.
    assert bound == pytest.approx(np.sqrt(sigma**2 + 1.0 / 12.0) / np.sqrt(electrons), rel=0.01)


def test_error_of_a_faint_line_is_above_the_bound() -> None:
    faint = gaussian_line(2.0, 0.3, 20_000.0)
    assert line_bound(faint, 700.0)[0] < gravity_error(faint, 700.0)[0]


@pytest.mark.parametrize("sigma", [0.4, 1.0, 4.0])
def test_error_of_a_bright_line_is_that_of_the_cut(sigma: float) -> None:
    """The centre of gravity above a third, worked out for a Gaussian at each place in a pixel."""
    errors = []
    pixels = np.arange(64)
    for shift in np.arange(CELLS) / CELLS:
        centre = 32.3 + shift
        mean = ndtr((pixels + 0.5 - centre) / sigma) - ndtr((pixels - 0.5 - centre) / sigma)
        mean[mean < mean.max() / 3.0] = 0.0
        errors.append(mean @ pixels / mean.sum() - centre)
    found = gravity_error(gaussian_line(sigma, 0.3, 1e11), 0.0)[0]
    assert found == pytest.approx(np.std(errors), rel=0.02)


def test_the_stop_without_coma_makes_lines_symmetrical() -> None:
    """Where Seidel's sums put it, traced lines at the row's end are lopsided the least."""
    at = coma_free_stop_mm()
    assert -9.0 < at < -7.5
    row_end = np.array([[0.5 * FIELD_U, 0.0]])
    places: tuple[StopPlace, ...] = ("8 mm in front", "on the plane face", "on the curved face")
    lopsided = [
        abs(line_figures(stopped_lens(4.0, place, -2.0), 4.0, row_end)[0].asymmetry_px)
        for place in places
    ]
    assert lopsided[0] < 0.1 * lopsided[1] < 0.1 * lopsided[2]


def test_light_grows_with_the_stop() -> None:
    light = [
        line_figures(stopped_lens(width), width, FIELD)[0].electrons for width in (2.0, 4.0, 8.0)
    ]
    assert np.array(light) / light[0] == pytest.approx([1.0, 2.0, 4.0], rel=0.02)


def test_more_stop_makes_wider_lines_off_the_axis() -> None:
    widths = [
        line_figures(stopped_lens(width, "8 mm in front", -2.0), width, FIELD)[2].middle_50_px
        for width in (2.0, 4.0, 6.0)
    ]
    assert widths[0] < widths[1] < widths[2]


def test_the_field_is_focused_nearer_than_the_middle() -> None:
    """Curvature of field, inward."""
    whole = best_focus_mm(4.0, "8 mm in front", FIELD)
    middle = best_focus_mm(4.0, "8 mm in front", FIELD[:1])
    assert whole < middle - 1.0
    assert abs(middle) < 0.5


def test_the_best_focus_is_within_what_is_searched() -> None:
    """Behind the lens it lies farthest from the paraxial image; to either side lines are wider."""
    best = best_focus_mm(2.0, "4 mm behind", FIELD)
    assert NEAREST_MM + 2.0 < best < -2.0

    def width(focus_mm: float) -> float:
        lines = line_figures(stopped_lens(2.0, "4 mm behind", focus_mm), 2.0, FIELD)
        return root_mean_square([line.middle_50_px for line in lines])

    assert width(best) < min(width(best - 0.5), width(best + 0.5))


def test_the_error_of_gravity_is_known_to_a_percent() -> None:
    """So well that 2 mm and 3 mm can be told apart or not: by lines of one shape, other noise."""
    lines = gaussian_line(2.0, 0.3, 20_000.0)
    many = StripeProfiles(np.zeros(8, np.int64), np.repeat(lines.cell_sr, 8, axis=0))
    errors = gravity_error(many, 700.0)
    assert 0.0 < np.std(errors, ddof=1) < 0.015 * errors.mean()


def test_the_lens_without_a_stop_has_a_line_of_hundreds_of_pixels() -> None:
    line = line_figures(stopped_lens(WIDTH_MM), WIDTH_MM, FIELD)[0]
    assert line.middle_50_px > 50.0


def test_the_case_is_there_with_its_picture() -> None:
    case = ALL_CASES["stop-and-focus"]
    assert isinstance(case, TablesCase)
    assert case.picture is not None
