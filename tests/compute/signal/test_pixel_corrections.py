"""Corrected counts in search and fit: the kernels against their definitions, and what it is for."""

from dataclasses import replace

import numpy as np
import pytest

from compute.errors import InvalidParameter
from compute.signal.centroid_finder import CentroidFinder
from compute.signal.centroid_reference import find_peaks_reference
from compute.signal.centroid_settings import CentroidSettings
from compute.signal.fit.fit_finder import FitFinder
from compute.signal.fit.fit_reference import fit_scans
from compute.signal.fit.fit_settings import FitSettings
from compute.signal.peaks import PeakFlag
from compute.signal.pixel_corrections import PixelCorrections
from compute.signal.sensor_noise import SensorNoise
from tests.compute.signal.fit.kernel_agreement import lines_that_differ
from validation.pixels.case import PIXELS as LINE_PIXELS
from validation.pixels.case import line_electrons
from validation.pixels.emva_sensor import Sensor, SensorDesign

PIXELS = LINE_PIXELS
NOISE = SensorNoise.of(10.0, 20.0, 100.0, 65535)
DESIGN = SensorDesign(
    pixels=PIXELS, prnu=0.03, dsnu_counts=3.0, hot=(60, 150), dead=(100,), stuck=(200, 201)
)
KNOWN = FitSettings(width_px=1.2, width_log_sigma=0.0, further_peaks=False)


def corrections_of(sensor):
    """The truth about a sensor."""
    scale = (1.0 / sensor.response).astype(np.float32)
    scale[sensor.bad] = 0.0
    offset = np.array([np.mean(sensor.offset[~sensor.bad])], np.float32)
    return PixelCorrections(
        sensor.offset.astype(np.float32)[None], scale[None], offset, np.zeros((1, 2), np.float32)
    )


@pytest.fixture(scope="module")
def sensor():
    return Sensor.make(DESIGN, np.random.default_rng(8))


def scans(sensor, slope, count=60):
    """Three lines in each, anywhere, on a background with a slope [electrons/px]."""
    rng = np.random.default_rng(11)
    light = sum(
        line_electrons(rng.uniform(10.0, PIXELS - 10.0, count), 1.0, 0.0)
        * 10.0 ** rng.uniform(3.0, 5.0, (count, 1))
        for _ in range(3)
    )
    ramp = slope * np.arange(PIXELS)
    return sensor.expose(light + 20.0 + ramp - ramp.min())


@pytest.fixture(params=["cpu", "cuda:0"])
def device(request):
    import warp as wp

    if request.param != "cpu" and not wp.is_cuda_available():
        pytest.skip("no CUDA device")
    return request.param


@pytest.mark.parametrize("slope", [0.0, 20.0, -10.0])
@pytest.mark.parametrize("calibrated", [False, True])
def test_kernels_agree_with_definition(sensor, device, slope, calibrated):
    lines = scans(sensor, slope)
    corrections = corrections_of(sensor) if calibrated else None
    settings = CentroidSettings()
    found = CentroidFinder(60, PIXELS, settings, NOISE, device, corrections=corrections).find(lines)
    expected = find_peaks_reference(lines, settings, NOISE, corrections)
    assert np.array_equal(found.count, expected.count)
    assert np.array_equal(found.flags, expected.flags)
    assert np.allclose(found.position_px, expected.position_px, atol=1e-9, equal_nan=True)
    for options in (FitSettings(), KNOWN):
        finder = FitFinder(60, PIXELS, options, NOISE, device=device, corrections=corrections)
        found = finder.find(lines)
        expected = fit_scans(lines, options, NOISE, corrections=corrections)
        assert not lines_that_differ(found, expected).any()
    assert bool(((found.flags & PeakFlag.MASKED_PIXELS) != 0).any()) == calibrated


def test_masked_pixel_is_left_out_and_said(sensor):
    place = np.full(200, 151.7)
    lines = sensor.expose(line_electrons(place, 60_000.0, 0.0) + 20.0)
    bound = sensor.position_bound_px(
        lambda at: line_electrons(np.array([at]), 1.0, 0.0)[0], 151.7, 60_000.0, 20.0
    )
    raw = FitFinder(200, PIXELS, KNOWN, NOISE, device="cpu").find(lines)
    found = FitFinder(
        200, PIXELS, KNOWN, NOISE, device="cpu", corrections=corrections_of(sensor)
    ).find(lines)
    assert np.all(found.flags[:, 0] == PeakFlag.MASKED_PIXELS)
    rms = np.sqrt(np.mean((found.position_px[:, 0] - 151.7) ** 2))
    # 200 lines: 5 % standard error.
    assert 0.85 * bound < rms < 1.2 * bound
    assert np.median(found.sigma_px[:, 0]) == pytest.approx(bound, rel=0.05)
    assert np.sqrt(np.mean((raw.position_px[:, 0] - 151.7) ** 2)) > 1.5 * bound


def test_hot_pixel_of_empty_lines_is_no_peak(sensor):
    lines = sensor.expose(np.full((100, PIXELS), 20.0))
    settings = CentroidSettings(min_width_px=1)
    raw = CentroidFinder(100, PIXELS, settings, NOISE, "cpu").find(lines)
    found = CentroidFinder(
        100, PIXELS, settings, NOISE, "cpu", corrections=corrections_of(sensor)
    ).find(lines)
    assert np.mean(raw.count > 0) > 0.9
    assert not found.count.any()


def test_slope_makes_neither_peaks_nor_bias():
    sensor = Sensor.make(SensorDesign(pixels=PIXELS), np.random.default_rng(2))
    ramp = 20.0 * np.arange(PIXELS)
    empty = sensor.expose(np.broadcast_to(ramp, (300, PIXELS)))
    finder = FitFinder(300, PIXELS, KNOWN, NOISE, device="cpu")
    assert not finder.find(empty).count.any()
    place = np.random.default_rng(4).uniform(60.0, 200.0, 300)
    found = finder.find(sensor.expose(line_electrons(place, 60_000.0, 0.0) + ramp))
    error = found.position_px[:, 0] - place
    assert np.all(found.count == 1)
    assert abs(np.mean(error)) < 4.0 * np.std(error) / np.sqrt(300)
    level = FitFinder(300, PIXELS, replace(KNOWN, background="level"), NOISE, device="cpu")
    biased = level.find(sensor.expose(line_electrons(place, 60_000.0, 0.0) + ramp))
    assert abs(np.mean(biased.position_px[:, 0] - place)) > 4.0 * np.std(error) / np.sqrt(300)


def test_misfit_widens_and_noise_does_not(sensor):
    # A line of another shape, and one of the right one.
    even = Sensor.make(SensorDesign(pixels=PIXELS), np.random.default_rng(2))
    place = np.full(300, 128.2)
    finder, plain = (
        FitFinder(300, PIXELS, replace(KNOWN, widen_misfit=widen), NOISE, device="cpu")
        for widen in (True, False)
    )
    right = even.expose(line_electrons(place, 60_000.0, 0.0) + 20.0)
    factor = finder.find(right).sigma_px[:, 0] / plain.find(right).sigma_px[:, 0]
    assert 1.0 <= np.mean(factor**2) < 1.02
    skewed = even.expose(line_electrons(place, 60_000.0, 0.5) + 20.0)
    found, narrow = finder.find(skewed), plain.find(skewed)
    factor = found.sigma_px[:, 0] / narrow.sigma_px[:, 0]
    assert np.allclose(factor**2, found.reduced_chi2[:, 0], rtol=0.3)


def test_corrections_of_another_sensor_are_refused(sensor):
    with pytest.raises(InvalidParameter, match=f"corrections are of 1 sensors with {PIXELS}"):
        CentroidFinder(4, 512, CentroidSettings(), NOISE, "cpu", corrections=corrections_of(sensor))
