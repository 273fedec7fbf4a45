"""The model of a window and its Jacobian; the bounds that follow from it."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from compute.errors import InvalidParameter
from compute.planning.cramer_rao import PixelNoise
from compute.signal.cramer_rao import position_bound
from compute.signal.fit.fit_settings import FitSettings
from compute.signal.fit.line_spread_function import LineSpreadFunction
from compute.signal.fit.window_model import WindowModel, Windows
from compute.signal.sensor_noise import SensorNoise
from tests.compute.signal.synthetic_scans import GAIN, NOISE, OFFSET, READ, gaussian_counts
from validation.joint_position_bounds import joint_position_bounds

PIXELS = 64
GAUSSIAN = LineSpreadFunction.gaussian()


def window(first=10, last=40, lines=1):
    return Windows.cut(
        np.zeros((1, PIXELS), np.uint16),
        np.zeros(lines, np.int64),
        np.full(lines, first),
        np.full(lines, last),
        NOISE,
    )


def test_the_model_is_pixel_integrated_lines_over_a_background():
    parameters = np.array([[120.0, 0.5, 300.0, 900.0, 20.3, 28.8, np.log(1.7)]])
    settings = FitSettings(background="slope", shape_error=0.1)
    model = WindowModel(2, settings, GAUSSIAN).evaluate(window(), parameters)
    pixel = np.arange(10, 41)
    height = np.array([300.0, 900.0]) / (1.7 * np.sqrt(2 * np.pi))
    lit = gaussian_counts(PIXELS, [20.3, 28.8], 1.7, height).sum(axis=0)[10:41]
    mean = lit + 120.0 + 0.5 * (pixel - 25.0)
    np.testing.assert_allclose(model.mean[0], mean, atol=1e-3)
    variance = (READ / GAIN) ** 2 + 1 / 12 + (mean - OFFSET) / GAIN + (0.1 * lit) ** 2
    np.testing.assert_allclose(model.variance[0], variance, rtol=1e-5)


@given(
    peaks=st.integers(1, 4),
    slope=st.booleans(),
    seed=st.integers(0, 2**32 - 1),
    log_width=st.floats(-1.2, 2.0),
    measured=st.booleans(),
)
def test_the_jacobian_is_the_derivative(peaks, slope, seed, log_width, measured):
    rng = np.random.default_rng(seed)
    settings = FitSettings(background="slope" if slope else "level")
    model = WindowModel(peaks, settings, GAUSSIAN)
    parameters = np.zeros((1, model.size))
    parameters[:, : model.background_size] = rng.uniform(-2.0, 200.0, model.background_size)
    parameters[:, model.light] = rng.uniform(-100.0, 1000.0, peaks)
    parameters[:, model.position] = rng.uniform(5.0, 45.0, peaks)
    parameters[:, -1] = log_width
    if measured:
        shape = LineSpreadFunction.from_cells(rng.uniform(0.0, 1.0, 64), -2.0, 1.0 / 16.0)
        model = WindowModel(peaks, settings, shape)
    expected = model.evaluate(window(), parameters)
    for k in range(model.size):
        step = np.zeros((1, model.size))
        step[0, k] = 1e-6
        ahead, behind = (
            model.evaluate(window(), parameters + sign * step).mean for sign in (1.0, -1.0)
        )
        numeric = (ahead - behind) / 2e-6
        # The table's second derivative jumps from place to place, by at most the step's error.
        scale = 1.0 + np.abs(parameters[:, model.light]).sum() * np.exp(-log_width)
        np.testing.assert_allclose(expected.jacobian[:, k], numeric, atol=3e-4 * scale)


def test_bounds_are_those_of_the_formulas():
    """One line, only its position unknown: I = sum (dmu/dx)^2 / (mu + read^2)."""
    settings = FitSettings(width_px=1.5, width_log_sigma=0.0)
    place, light, ambient, step = 30.3, 5000.0, 200.0, 1e-4
    height = light / GAIN / (1.5 * np.sqrt(2 * np.pi))
    ahead, here, behind = (
        GAIN * gaussian_counts(PIXELS, place + by, 1.5, height)[0] for by in (step, 0.0, -step)
    )
    slope = (ahead - behind) / (2 * step)
    variance = here + ambient + READ**2 + GAIN**2 / 12
    strict = joint_position_bounds(
        [[place]], [light], ambient, PIXELS, settings, NOISE, only_positions=True
    )
    assert strict[0, 0, 0] == pytest.approx(1.0 / (slope**2 / variance).sum(), rel=1e-5)
    # Unknown brightness, too, is what planning asks; background and width cost next to nothing.
    noise = PixelNoise(READ, GAIN, ambient)
    bright = position_bound(here, slope, noise.variance_electrons2)
    nuisance = joint_position_bounds([[place]], [light], ambient, PIXELS, settings, NOISE)
    assert np.sqrt(strict[0, 0, 0]) == pytest.approx(bright, rel=1e-4)
    assert strict[0, 0, 0] < nuisance[0, 0, 0] < 1.01 * bright**2
    with pytest.raises(InvalidParameter):
        joint_position_bounds([place], [light], ambient, PIXELS, settings, NOISE)


def test_bounds_of_two_lines_meet_those_of_one_when_far_and_grow_when_near():
    known = FitSettings(width_px=2.0, width_log_sigma=0.0)
    free = FitSettings(width_px=2.0, width_log_sigma=np.inf)
    single = joint_position_bounds([[20.0]], [1e4], 200.0, PIXELS, known, NOISE)[0, 0, 0]
    variances = []
    for apart in (24.0, 8.0, 4.0, 2.0):
        pair = joint_position_bounds(
            [[20.0, 20.0 + apart]], [1e4, 1e4], 200.0, PIXELS, known, NOISE
        )[0]
        wide = joint_position_bounds(
            [[20.0, 20.0 + apart]], [1e4, 1e4], 200.0, PIXELS, free, NOISE
        )[0]
        assert wide[0, 0] >= pair[0, 0]
        for spread, low, high in ((1e-5, 0.0, 0.01), (0.02, 0.1, 0.9)):
            prior = FitSettings(width_px=2.0, width_log_sigma=spread)
            some = joint_position_bounds(
                [[20.0, 20.0 + apart]], [1e4, 1e4], 200.0, PIXELS, prior, NOISE
            )[0, 0, 0]
            assert pair[0, 0] + low * (wide - pair)[0, 0] <= some * (1 + 1e-9)
            assert some <= pair[0, 0] + high * (wide - pair)[0, 0] + 1e-9
        variances.append(pair[0, 0])
    assert variances[0] == pytest.approx(single, rel=0.01)
    assert variances == sorted(variances)


def test_the_share_of_the_middle_pixel():
    model = WindowModel(1, FitSettings(), GAUSSIAN)
    share = model.central_pixel_fraction(np.array([0.5, 2.0]), np.zeros(2, np.int64), np.zeros(2))
    np.testing.assert_allclose(share, [0.682689, 0.197413], atol=1e-6)


def test_windows_leave_saturated_pixels_out():
    lines = np.full((2, PIXELS), 200, np.uint16)
    lines[1, 20] = 4095
    noise = SensorNoise.of([10.0, 5.0], [20.0, 7.0], [100.0, 90.0], 4095)
    windows = Windows.cut(lines, np.array([0, 1]), np.array([10, 18]), np.array([30, 22]), noise)
    assert windows.values.shape == (2, 21)
    np.testing.assert_array_equal(windows.count, [21, 4])
    np.testing.assert_array_equal(windows.noise.offset[:, 0], [100.0, 90.0])
    np.testing.assert_array_equal(windows.offset_from_centre[1, :5], [-2, -1, 0, 1, 2])
