"""Line images against independent integration, and what must be conserved."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.integrate import quad

from compute.optics.pixel_solid_angles import stripe_images

PIXELS = 256


def image(position_px: float, sigma_px: float, electrons: float) -> NDArray[np.float64]:
    return stripe_images(
        np.array([[position_px]]), np.array([[sigma_px]]), np.array([[electrons]]), PIXELS
    )[0]


@given(
    position_px=st.floats(60.0, 190.0),
    sigma_px=st.floats(0.1, 8.0),
    electrons=st.floats(1.0, 1e7),
)
def test_all_electrons_of_a_spot_within_the_line_land_on_it(
    position_px: float, sigma_px: float, electrons: float
) -> None:
    # The tails beyond 6 sigma hold 2e-9.
    assert image(position_px, sigma_px, electrons).sum() == pytest.approx(electrons, rel=3e-9)


@given(position_px=st.floats(60.0, 190.0), sigma_px=st.floats(1.0, 8.0))
def test_the_centroid_is_the_position(position_px: float, sigma_px: float) -> None:
    light = image(position_px, sigma_px, 1e5)
    centroid = light @ np.arange(PIXELS) / light.sum()
    # Sampling by pixels moves the centroid by at most exp(-2 pi^2 sigma^2) / pi, 1e-9 px here;
    # the cut tails by at most 2e-9 x 6.5 sigma.
    assert centroid == pytest.approx(position_px, abs=2e-7)


@pytest.mark.parametrize(("position_px", "sigma_px"), [(100.3, 2.0), (100.5, 0.3), (17.0, 5.0)])
def test_each_pixel_holds_the_integral_over_its_width(position_px: float, sigma_px: float) -> None:
    light = image(position_px, sigma_px, 1.0)

    def shape(x: float) -> float:
        return float(
            np.exp(-((x - position_px) ** 2) / (2 * sigma_px**2)) / sigma_px / np.sqrt(2 * np.pi)
        )

    for pixel in range(int(position_px) - 8, int(position_px) + 9):
        expected, _ = quad(shape, pixel - 0.5, pixel + 0.5, epsabs=1e-13)
        assert light[pixel] == pytest.approx(expected, abs=1e-12)


def test_a_spot_at_the_edge_leaves_half_of_its_light() -> None:
    assert image(-0.5, 2.0, 1000.0).sum() == pytest.approx(500.0, rel=1e-8)
    assert image(PIXELS - 0.5, 2.0, 1000.0).sum() == pytest.approx(500.0, rel=1e-8)


def test_a_spot_outside_leaves_its_tail_on_the_near_end() -> None:
    light = image(-3.5, 2.0, 1000.0)
    assert light.sum() == pytest.approx(1000.0 * 0.0668072, rel=1e-5)  # 1.5 sigma from the edge
    assert (np.diff(light[:8]) < 0.0).all()
    assert light[20:].sum() == 0.0


@pytest.mark.parametrize("position_px", [-1e9, -40.0, PIXELS + 40.0, 1e12, np.nan, np.inf])
def test_a_spot_far_outside_or_nowhere_leaves_nothing(position_px: float) -> None:
    assert image(position_px, 2.0, 1e6).sum() == 0.0


def test_spots_add_up_and_lines_stay_apart() -> None:
    position = np.array([[50.2, 52.9], [200.0, np.nan]])
    sigma = np.array([[2.0, 1.0], [3.0, 2.0]])
    electrons = np.array([[100.0, 250.0], [70.0, 900.0]])
    both = stripe_images(position, sigma, electrons, PIXELS)
    assert both.shape == (2, PIXELS)
    np.testing.assert_allclose(
        both[0], image(50.2, 2.0, 100.0) + image(52.9, 1.0, 250.0), atol=1e-6
    )
    np.testing.assert_allclose(both[1], image(200.0, 3.0, 70.0), atol=1e-6)


def test_no_spots_give_dark_lines() -> None:
    nothing = np.zeros((3, 0))
    dark = stripe_images(nothing, nothing, nothing, PIXELS)
    assert dark.dtype == np.float64
    np.testing.assert_array_equal(dark, np.zeros((3, PIXELS)))
