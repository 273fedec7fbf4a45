"""Cramer-Rao bound of a stripe's position: by calculus, by fits, against the centroid finder."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.special import ndtr

from compute.errors import InvalidParameter
from compute.optics.detector import Detector
from compute.optics.stripe_optics.stripe_profile import CELLS, StripeProfiles
from compute.planning.cramer_rao import (
    SHIFT_PX,
    PixelNoise,
    Stripes,
    centre_of_gravity_sigma,
    centroids,
    displaced_stripes,
    shifted_stripes,
)
from compute.signal.centroid_settings import CentroidSettings
from compute.signal.cramer_rao import position_bound
from tests.compute.planning.gaussian_optics import GaussianOptics
from tests.compute.rig import PIXELS, control_points, rig

NOISE = PixelNoise(read_noise_electrons=30.0, electrons_per_count=12.0, background_electrons=50.0)
EDGES = np.arange(42) - 20.5


def gaussian(position: float, sigma: float) -> np.ndarray:
    return np.diff(ndtr((EDGES - position) / sigma))


def gaussian_slope(position: float, sigma: float) -> np.ndarray:
    density = np.exp(-0.5 * ((EDGES - position) / sigma) ** 2) / (sigma * np.sqrt(2.0 * np.pi))
    return -np.diff(density)


def known_brightness(mean: np.ndarray, slope: np.ndarray) -> np.ndarray:
    return position_bound(mean, slope, NOISE.variance_electrons2, known_brightness=True)


def displaced(sigma: float, points: np.ndarray) -> tuple[GaussianOptics, Stripes]:
    optics = GaussianOptics(rig(4), sigma)
    return optics, displaced_stripes(optics, optics.cameras, points, PIXELS)


def test_much_light_and_a_wide_line() -> None:
    """sigma / sqrt(electrons): the bound of a Gaussian with photon noise alone."""
    electrons, sigma = 1e8, 3.0
    quiet = PixelNoise(0.1, 1e-3)
    bound = position_bound(
        electrons * gaussian(0.3, sigma),
        electrons * gaussian_slope(0.3, sigma),
        quiet.variance_electrons2,
    )
    # Pixels of width 1 widen the line by 1/12 px^2.
    assert bound == pytest.approx(np.sqrt((sigma**2 + 1.0 / 12.0) / electrons), rel=2e-3)


def test_little_light_and_a_wide_line() -> None:
    """Read noise alone: I = N^2 / (4 sqrt(pi) sigma^3 read^2), from the integral of g'^2."""
    electrons, sigma, read = 1e-3, 3.0, 10.0
    dark = PixelNoise(read, 1e-6)
    integral = quad(lambda x: (x * np.exp(-(x**2) / 18.0)) ** 2, -30, 30)[0]
    information = (electrons / read) ** 2 * integral / (2 * np.pi * sigma**6)
    assert information == pytest.approx(
        electrons**2 / (4 * np.sqrt(np.pi) * sigma**3 * read**2), rel=1e-6
    )
    bound = position_bound(
        electrons * gaussian(0.0, sigma),
        electrons * gaussian_slope(0.0, sigma),
        dark.variance_electrons2,
    )
    assert bound == pytest.approx(information**-0.5, rel=0.02)


@pytest.mark.parametrize("sigma", [0.3, 0.5, 1.5, 4.0])
def test_derivatives_of_displaced_lines_are_those_of_calculus(sigma: float) -> None:
    points = control_points(12)
    optics, found = displaced(sigma, points)
    position = optics.cameras.project(points)
    for n, s in np.ndindex(12, 4):
        centre = position[n, s] - found.first_px[n, s]
        edges = np.arange(found.mean_sr.shape[2] + 1) - 0.5
        np.testing.assert_allclose(
            found.mean_sr[n, s], np.diff(ndtr((edges - centre) / sigma)), atol=1e-6
        )
        density = np.exp(-0.5 * ((edges - centre) / sigma) ** 2)
        exact = -np.diff(density) / (sigma * np.sqrt(2.0 * np.pi))
        # The central difference's own error, see SHIFT_PX.
        most = (SHIFT_PX / sigma) ** 2 + 1e-3
        assert np.abs(found.slope_sr_per_px[n, s] - exact).max() < most * np.abs(exact).max()


@given(st.floats(-0.5, 0.5), st.floats(0.5, 4.0), st.integers(-30, 2060))
@settings(max_examples=40, deadline=None)
def test_shifted_lines_are_those_of_calculus_too(place: float, sigma: float, first: int) -> None:
    """A Gaussian on the fine grid, shifted by a cell: pixels, derivative, and the sensor's end."""
    edges = np.arange(41 * CELLS + 1) / CELLS - 20.5
    cells = np.diff(ndtr((edges - place) / sigma))[None]
    other = StripeProfiles(np.array([first + 7]), cells[:, : 30 * CELLS])
    found = shifted_stripes([StripeProfiles(np.array([first]), cells), other], PIXELS)
    assert found.first_px.tolist() == [[first - 1, first + 6]]
    pixel = first + np.arange(-1, found.mean_sr.shape[2] - 1)
    inside = (pixel >= 0) & (pixel < PIXELS)
    whole = np.arange(found.mean_sr.shape[2] + 1) - 21.5
    mean = np.diff(ndtr((whole - place) / sigma))
    np.testing.assert_allclose(found.mean_sr[0, 0], np.where(inside, mean, 0.0), atol=1e-6)
    density = np.exp(-0.5 * ((whole - place) / sigma) ** 2) / (sigma * np.sqrt(2.0 * np.pi))
    slope = np.where(inside, -np.diff(density), 0.0)
    most = (1.0 / CELLS / sigma) ** 2 * np.abs(np.diff(density)).max() + 1e-6
    np.testing.assert_allclose(found.slope_sr_per_px[0, 0], slope, atol=most)


@pytest.mark.parametrize(("sigma", "electrons"), [(0.6, 2e4), (1.2, 2e3), (1.2, 2e5)])
def test_a_fit_of_the_line_reaches_it(sigma: float, electrons: float) -> None:
    """Gauss-Newton for position and brightness, weighted, on lines with all the noise."""
    trials, position = 3000, 0.27
    rng = np.random.default_rng(8)
    mean = electrons * gaussian(position, sigma)
    slope = electrons * gaussian_slope(position, sigma)
    lines = rng.poisson(mean + NOISE.background_electrons, (trials, len(mean)))
    lines = lines + NOISE.read_noise_electrons * rng.standard_normal(lines.shape)
    gain = NOISE.electrons_per_count
    lines = np.rint(lines / gain) * gain - NOISE.background_electrons
    # One step from the truth is the whole way: the bound is for small errors.
    weight = 1.0 / (mean + NOISE.variance_electrons2)
    design = np.column_stack([slope, mean])
    solved = np.linalg.solve((design.T * weight) @ design, (design.T * weight) @ (lines - mean).T)
    bound = float(position_bound(mean, slope, NOISE.variance_electrons2))
    assert solved[0].std() == pytest.approx(bound, rel=5.0 / np.sqrt(2.0 * trials))


@given(st.floats(-0.5, 0.5), st.floats(0.5, 4.0), st.floats(1e2, 1e6))
@settings(max_examples=60, deadline=None)
def test_an_unknown_brightness_costs_little_and_never_helps(
    position: float, sigma: float, electrons: float
) -> None:
    mean, slope = electrons * gaussian(position, sigma), electrons * gaussian_slope(position, sigma)
    known = float(known_brightness(mean, slope))
    bound = float(position_bound(mean, slope, NOISE.variance_electrons2))
    assert known * (1 - 1e-12) <= bound
    # A Gaussian is symmetric: what is mixed comes from the sampling alone.
    assert bound <= 1.2 * known


def test_a_lopsided_line_pays_for_its_brightness() -> None:
    """A line cut by the sensor's end: fainter and moved out look alike."""
    mean, slope = 1e4 * gaussian(0.0, 2.0), 1e4 * gaussian_slope(0.0, 2.0)
    half = np.arange(41) >= 20
    known = float(known_brightness(mean[half], slope[half]))
    assert position_bound(mean[half], slope[half], NOISE.variance_electrons2) > 1.2 * known


def test_the_finder_comes_close_but_not_below() -> None:
    """Above the bound, within twice of it, but for the 0.01 px that light does not take away."""
    sigma = 1.2
    for electrons in (3e3, 3e4, 3e5):
        mean = electrons * gaussian(0.27, sigma)
        bound = float(
            position_bound(mean, electrons * gaussian_slope(0.27, sigma), NOISE.variance_electrons2)
        )
        [found] = centre_of_gravity_sigma(mean[None], NOISE, CentroidSettings())
        assert bound < found < np.hypot(2.0 * bound, 0.012)


def test_more_light_does_not_help_the_published_method() -> None:
    """[4.1] cuts at a threshold without correction: pixels that enter make the position jump."""
    bright = np.array([1e5 * gaussian(0.27, 1.2)])
    quiet = PixelNoise(30.0, 12.0)
    published = CentroidSettings(weighting="above-background")
    assert centre_of_gravity_sigma(bright, quiet, published)[0] > 0.03
    assert centre_of_gravity_sigma(bright, quiet, CentroidSettings())[0] < 0.02


def test_no_light_says_nothing() -> None:
    dark = np.zeros((2, 41))
    assert np.isinf(position_bound(dark, dark, NOISE.variance_electrons2)).all()
    assert np.isnan(centre_of_gravity_sigma(dark, NOISE, CentroidSettings())).all()
    points = np.vstack([control_points(4), [[0.0, 0.0, -1000.0]]])
    optics, found = displaced(1.0, points)
    assert (found.slope_sr_per_px[4] == 0.0).all()
    assert (found.slope_sr_per_px[:4] != 0.0).any(axis=2).all()
    position, light = centroids(optics.solid_angles(points), PIXELS)
    assert np.isnan(position[4]).all()
    assert (light[4] == 0.0).all()
    assert light[:4] == pytest.approx(np.ones((4, 4)))


def test_beyond_the_end_there_is_no_pixel() -> None:
    """A line moved over the end, pixel by pixel, loses its light and then its bound."""
    points = np.column_stack([np.full(30, -300.0), np.linspace(380.0, 640.0, 30), np.ones(30)])
    points[:, 2] = 1500.0
    optics, found = displaced(2.0, np.vstack([points, -points + [0.0, 0.0, 3000.0]]))
    position, light = centroids(optics.solid_angles(points), PIXELS)
    assert light[0, 0] == pytest.approx(1.0)
    assert light[-1, 0] == 0.0
    assert (np.diff(light[:, 0]) <= 1e-12).all()
    np.testing.assert_allclose(found.mean_sr[:30].sum(axis=2), light, atol=1e-12)
    # The centre of gravity is the whole line's.
    np.testing.assert_allclose(position, optics.cameras.project(points), atol=1e-6)


def test_a_volume_behind_the_sensors_is_refused() -> None:
    with pytest.raises(InvalidParameter, match="no sensor sees the middle"):
        displaced(1.0, np.array([[0.0, 0.0, -1500.0]]))


def test_noise_of_a_detector() -> None:
    detector = Detector(12, 12.0, 20.0, 30.0, 5e4, 40.0, dark_electrons=10.0)
    assert PixelNoise.of(detector) == NOISE
    assert NOISE.variance_electrons2 == 50.0 + 900.0 + 12.0


@pytest.mark.parametrize(
    ("read", "gain", "background", "name"),
    [(-1.0, 1.0, 0.0, "read"), (1.0, np.nan, 0.0, "per_count"), (1.0, 1.0, -2.0, "background")],
)
def test_noise_that_is_refused(read: float, gain: float, background: float, name: str) -> None:
    with pytest.raises(InvalidParameter, match=name):
        PixelNoise(read, gain, background)


def test_no_noise_at_all_is_refused() -> None:
    with pytest.raises(InvalidParameter, match="all 0"):
        PixelNoise(0.0, 0.0)
    with pytest.raises(InvalidParameter, match="electrons_per_count"):
        centre_of_gravity_sigma(np.zeros((1, 9)), PixelNoise(1.0, 0.0), CentroidSettings())
