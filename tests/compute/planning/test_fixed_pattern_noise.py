"""Fixed-pattern noise: by fits of simulated nonuniform pixels, up to the points."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import ndtr

from compute.errors import InvalidParameter
from compute.optics.detector import Detector
from compute.optics.detector_array import fixed_pattern
from compute.optics.profiles.profile_loader import load_profile
from compute.planning.cramer_rao import PixelNoise
from compute.planning.fixed_pattern_noise import PixelNonuniformity, fixed_pattern_sigma
from compute.planning.plan import plan
from compute.planning.planning_device import planning_device
from compute.planning.precision import precision_from_jacobian, propagated_sigma, reading_gain
from compute.planning.simulated_readings import simulate_readings
from compute.reconstruction.triangulation import reconstruct

WIDTH = 41
EDGES = np.arange(WIDTH + 1) - 20.5
DETECTOR = Detector(
    12, 50.0, 40.0, 30.0, 2e5, 40.0, dark_electrons=200.0, response_nonuniformity=0.02,
    dark_nonuniformity=0.3, offset_nonuniformity_counts=1.0,
)  # fmt: skip


def gaussian(position: float | np.ndarray, sigma: float) -> np.ndarray:
    return np.diff(ndtr((EDGES - position) / sigma))


def gaussian_slope(position: float | np.ndarray, sigma: float) -> np.ndarray:
    density = np.exp(-0.5 * ((EDGES - position) / sigma) ** 2) / (sigma * np.sqrt(2.0 * np.pi))
    return -np.diff(density)


def fitted(lines: np.ndarray, electrons: float, sigma: float, weight: np.ndarray) -> np.ndarray:
    """Fit position and brightness to lines (L, W), by Gauss-Newton to the end."""
    found = np.tile([0.0, electrons], (len(lines), 1))
    for _ in range(8):
        shape = gaussian(found[:, :1], sigma)
        slope = gaussian_slope(found[:, :1], sigma)
        design = np.stack([slope * found[:, 1:], shape], axis=2)
        rest = lines - shape * found[:, 1:]
        normal = np.einsum("lwi,w,lwj->lij", design, weight, design)
        right = np.einsum("lwi,w,lw->li", design, weight, rest)
        step = np.linalg.solve(normal, right[..., None])[..., 0]
        found = found + step
    assert np.abs(step[:, 0]).max() < 1e-6
    return found[:, 0]


@pytest.mark.parametrize(
    ("sigma", "electrons", "position"), [(0.6, 2e5, 0.27), (1.2, 1e4, -0.4), (2.5, 1e5, 0.0)]
)
def test_lines_of_simulated_pixels_are_moved_so_much(
    sigma: float, electrons: float, position: float
) -> None:
    """Mean counts, without noise, of 2000 sensors; fitted with what is known of nominal pixels."""
    lines = 2000
    pattern = fixed_pattern(DETECTOR, lines, WIDTH, seed=5)
    mean = electrons * gaussian(position, sigma)
    light = (mean + DETECTOR.ambient_electrons) * pattern.response + pattern.dark_electrons
    light += (pattern.offset_counts - DETECTOR.offset_counts) * DETECTOR.electrons_per_count
    light -= DETECTOR.ambient_electrons + DETECTOR.dark_electrons
    noise = PixelNoise.of(DETECTOR)
    weight = 1.0 / (mean + noise.variance_electrons2)
    error = fitted(light, electrons, sigma, weight) - position
    slope = electrons * gaussian_slope(position, sigma)
    told = float(fixed_pattern_sigma(mean, slope, noise, PixelNonuniformity.of(DETECTOR)))
    assert error.std() == pytest.approx(told, rel=5.0 / np.sqrt(2.0 * lines))
    assert abs(error.mean()) < 5.0 * told / np.sqrt(lines)


@given(st.floats(-0.5, 0.5), st.floats(0.5, 4.0), st.floats(0.0, 0.2))
@settings(max_examples=40, deadline=None)
def test_it_grows_with_the_pixels_differences_and_light_does_not_help(
    position: float, sigma: float, share: float
) -> None:
    noise = PixelNoise(1.0, 1.0)

    def error(electrons: float, part: float) -> float:
        mean = electrons * gaussian(position, sigma)
        slope = electrons * gaussian_slope(position, sigma)
        return float(fixed_pattern_sigma(mean, slope, noise, PixelNonuniformity(part)))

    assert error(1e6, share) == pytest.approx(share * error(1e6, 1.0), abs=1e-12)
    assert error(1e8, 0.01) == pytest.approx(error(1e6, 0.01), rel=0.1)


@pytest.mark.slow
def test_a_bars_points_are_moved_so_much() -> None:
    """Readings of the traced lines on 400 sets of pixels, reconstructed with the noise's weights.

    One step of the fit is the whole way: a hundredth of the light moves lines by 0.01 px.
    """
    sets = 400
    bar = load_profile("bar")
    found = plan(bar, grid=3, markers=1)
    point = found.points[9]
    device = planning_device(bar)
    place = np.array([point.position_mm])
    look = device.image_points(place)
    told = simulate_readings(
        device, np.array([one.position_mm for one in found.points]), lambda _: None
    )
    lines = device.lines(look, told.cameras)
    electrons = device.electrons_per_sr(place)[..., None]
    mean, slope = (lines.mean_sr * electrons)[0], (lines.slope_sr_per_px * electrons)[0]
    detector = bar.detector.detector(bar.rates.exposure_s)
    weight = 1.0 / (mean + device.noise.variance_electrons2)
    moved = np.empty((sets, len(mean)))
    for number in range(sets):
        pattern = fixed_pattern(detector, *mean.shape, seed=number)
        rest = (pattern.response - 1.0) * (mean + detector.ambient_electrons)
        rest += pattern.dark_electrons - detector.dark_electrons
        for sensor, (a, b, w, r) in enumerate(zip(slope, mean, weight, rest, strict=True)):
            design = np.column_stack([a, b])
            normal, right = (design.T * w) @ design, (design.T * w) @ r
            moved[number, sensor] = np.linalg.solve(normal, right)[0]
    exact = told.cameras.project(place)
    sigma = told.bound_px[9]
    points = reconstruct(told.cameras, exact + moved, sigma).position_mm
    assert point.fixed_pattern_mm is not None
    np.testing.assert_allclose(
        points.std(axis=0), point.fixed_pattern_mm, rtol=5.0 / np.sqrt(2.0 * sets)
    )
    np.testing.assert_allclose(
        moved.std(axis=0), told.pattern_px[9], rtol=5.0 / np.sqrt(2.0 * sets)
    )


@pytest.mark.slow
def test_without_differences_there_is_no_pattern_and_the_noise_stays() -> None:
    bar = load_profile("bar")
    alike = replace(bar.detector, response_nonuniformity=0.0, dark_nonuniformity=0.0)
    found = plan(replace(bar, detector=alike), grid=3, markers=1)
    usual = plan(bar, grid=3, markers=1)
    assert found.fixed_pattern.worst == (0.0, 0.0, 0.0)
    assert found.noise == usual.noise
    assert usual.fixed_pattern.best is not None
    assert min(usual.fixed_pattern.best) > 0.0


def test_errors_as_large_as_the_noise_spread_as_the_noise() -> None:
    rng = np.random.default_rng(3)
    slopes = rng.normal(size=(6, 4, 3))
    slopes[2, 1] = np.nan
    slopes[3, :2] = np.nan
    sigma = rng.uniform(0.5, 2.0, (6, 4))
    sd = precision_from_jacobian(slopes, sigma).sd_mm
    assert np.isnan(sd[3]).all()
    np.testing.assert_allclose(propagated_sigma(reading_gain(slopes, sigma), sigma), sd, rtol=1e-9)
    # Other weights than the errors' own cannot make it better.
    error = sigma * rng.uniform(0.2, 5.0, sigma.shape)
    best = precision_from_jacobian(slopes, error).sd_mm
    spread = propagated_sigma(reading_gain(slopes, sigma), error)
    assert np.nanmin(spread / best) > 1.0 - 1e-9


def test_no_light_no_position() -> None:
    dark = np.zeros((2, WIDTH))
    noise = PixelNoise.of(DETECTOR)
    assert np.isinf(fixed_pattern_sigma(dark, dark, noise, PixelNonuniformity.of(DETECTOR))).all()


def test_what_is_refused() -> None:
    with pytest.raises(InvalidParameter, match=r"response_nonuniformity is -0\.1"):
        PixelNonuniformity(-0.1)
    with pytest.raises(InvalidParameter, match="unlit_electrons is nan"):
        PixelNonuniformity(0.1, 0.0, np.nan)
    with pytest.raises(InvalidParameter, match="error_px has the shape"):
        propagated_sigma(np.ones((2, 3, 4)), np.ones((2, 3)))
