"""Deviations averaged over unknown widths: honest where light is scarce, and nothing elsewhere."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import ndtr

from compute.signal.centroid_reference import background_levels, find_peaks_reference
from compute.signal.centroid_settings import CentroidSettings
from compute.signal.fit.candidate_groups import form_groups, initial_parameters
from compute.signal.fit.fisher_scoring import solve
from compute.signal.fit.fit_finder import FitFinder
from compute.signal.fit.fit_reference import fit_scans
from compute.signal.fit.fit_settings import NARROW_PX, WIDTH_LIMITS_PX, FitSettings
from compute.signal.fit.line_spread_function import LineSpreadFunction
from compute.signal.fit.width_marginalisation import marginalise_width
from compute.signal.fit.window_model import WindowModel, Windows
from compute.signal.peaks import PeakFlag
from compute.signal.sensor_noise import SensorNoise
from tests.compute.signal.fit.kernel_agreement import lines_that_differ
from tests.compute.signal.synthetic_scans import GAIN, NOISE, OFFSET, gaussian_counts, measured

PIXELS = 96
MIDDLE = 48.0
# Finds all but one faint line in a thousand; and noise, which is told apart by its place.
SEARCH = CentroidSettings(detection_sigma=4.5, min_width_px=1)
FREE = FitSettings(search=SEARCH, width_log_sigma=np.inf)
SCARCE = [(0.6, 50.0), (1.0, 50.0), (2.0, 20.0), (0.6, 20.0)]
"""Width [px] and read noise [electrons] of lines of a thousand electrons."""


def noise_of(read):
    return SensorNoise.of(GAIN, read, OFFSET, 65535)


def faint_lines(width, read, count, seed):
    """Lines of a thousand electrons at places all over a pixel."""
    rng = np.random.default_rng(seed)
    place = MIDDLE + rng.uniform(-0.5, 0.5, count)
    edge = np.arange(PIXELS + 1) - 0.5
    light = 1e3 * np.diff(ndtr((edge - place[:, None]) / width), axis=1)
    seen = rng.poisson(light + 20.0) + rng.normal(0.0, read, light.shape)
    return place, np.clip(np.rint(seen / GAIN + OFFSET), 0, 65535).astype(np.uint16)


def solved(lines, options, noise):
    """The first windows of lines' first candidates, and their fits before they are averaged."""
    model = WindowModel(1, options, LineSpreadFunction.gaussian())
    candidates = find_peaks_reference(lines, options.search, noise)
    groups = form_groups(candidates, PIXELS, options)
    groups = groups[groups.count == 1]
    windows = Windows.cut(lines, groups.scan, groups.first_px, groups.last_px, noise)
    groups = replace(groups, level=background_levels(lines)[groups.scan])
    start = initial_parameters(model, groups, candidates, windows.sensor)
    return windows, model, solve(model, windows, start)


@pytest.mark.parametrize(("width", "read", "spread"), [(0.6, 50.0, np.inf), (1.0, 50.0, 2.0)])
def test_faint_lines_of_unknown_width_are_honest(width, read, spread):
    """Squared errors in stated deviations average 0.95 to 1.05, with three standard errors.

    Of 30 000 lines: not averaged, those of one pixel have 1.11, and with any width as probable
    as any other those of 0.6 px have 1.4.
    """
    count = 30_000
    place, lines = faint_lines(width, read, count, 3)
    options = FitSettings(search=SEARCH, width_log_sigma=spread)
    found = FitFinder(count, PIXELS, options, noise_of(read), device="cpu").find(lines)
    error = np.where(np.isnan(found.position_px), np.inf, found.position_px - place[:, None])
    own = np.argmin(np.abs(error), axis=1)
    row = np.arange(count)
    near = np.abs(error[row, own]) < 3.0 * max(width, 1.0)
    assert near.mean() > 0.997
    row, own = row[near], own[near]
    square = (error[row, own] / found.sigma_px[row, own]) ** 2
    assert abs(square.mean() - 1.0) < 0.05 + 3 * square.std() / np.sqrt(len(row))
    # Fits that go to and fro in the width would end as UNFITTED.
    assert ((found.flags[row, own] & PeakFlag.UNFITTED) != 0).mean() < 0.002


@pytest.mark.parametrize(("width", "read"), SCARCE)
def test_the_average_is_the_posterior(width, read):
    """By fits with known widths, close together, each with its likelihood."""
    noise = noise_of(read)
    _, lines = faint_lines(width, read, 12, 9)
    windows, model, fits = solved(lines, FREE, noise)
    assert fits.good.all()
    at, count = model.position.start, len(windows)
    log_widths = np.arange(*np.log(WIDTH_LIMITS_PX), 0.05)
    weight, place, variance = (np.full((len(log_widths), count), x) for x in (-np.inf, 0.0, 0.0))
    for number, log_width in enumerate(log_widths):
        known = FitSettings(search=SEARCH, width_px=np.exp(log_width), width_log_sigma=0.0)
        start = np.column_stack([fits.parameters[:, :-1], np.full(count, log_width)])
        given = solve(replace(model, settings=known), windows, start)
        good = given.good
        variance[number, good] = given.covariance[good, at, at]
        place[number, good] = given.parameters[good, at]
        prior = -((NARROW_PX / np.exp(log_width)) ** 4)
        weight[number, good] = (
            prior - 0.5 * given.deviance[good] + 0.5 * np.log(variance[number, good])
        )
    part = np.exp(weight - weight.max(axis=0))
    part /= part.sum(axis=0)
    mean = (part * place).sum(axis=0)
    expected = np.sqrt((part * (variance + (place - mean) ** 2)).sum(axis=0))
    averaged = marginalise_width(model, windows, fits)
    sigma = np.sqrt(averaged.covariance[:, at, at])
    assert sigma == pytest.approx(expected, rel=0.1)
    assert np.abs(sigma / expected - 1.0).mean() < 0.02
    # The parameters are the best ones all the same: the average's place is biased more.
    assert (averaged.parameters == fits.parameters).all()
    assert np.abs(averaged.parameters[:, at] - mean).max() > 1e-3
    eigenvalues = np.linalg.eigvalsh(averaged.covariance)
    assert (eigenvalues > 0.0).all()


def test_bright_lines_are_not_averaged():
    rng = np.random.default_rng(4)
    place = MIDDLE + rng.uniform(-0.5, 0.5, 50)
    lines = measured(gaussian_counts(PIXELS, place, 1.2, 2000.0), rng)
    windows, model, fits = solved(lines, FREE, NOISE)
    assert fits.good.all()
    assert marginalise_width(model, windows, fits) is fits


def test_a_known_width_is_not_averaged():
    known = FitSettings(search=SEARCH, width_px=1.0, width_log_sigma=0.0)
    _, lines = faint_lines(1.0, 50.0, 50, 5)
    windows, model, fits = solved(lines, known, noise_of(50.0))
    assert marginalise_width(model, windows, fits) is fits


def test_faint_lines_alone_and_in_pairs_agree_with_the_kernel():
    rng, count, pixels = np.random.default_rng(6), 200, 120
    place = 60 + rng.uniform(-0.5, 0.5, count)
    height, width = 10 ** rng.uniform(0.9, 2.2, count), rng.uniform(0.3, 3.0, count)
    second = gaussian_counts(
        pixels,
        place + width * rng.uniform(2.2, 5.0, count),
        width,
        height * rng.uniform(0.4, 1.0, count),
    )
    second[::2] = 0.0
    lines = measured(gaussian_counts(pixels, place, width, height) + second, rng)
    for spread, background in ((0.5, "slope"), (2.0, "level"), (np.inf, "level")):
        options = FitSettings(search=SEARCH, width_log_sigma=spread, background=background)
        expected = fit_scans(lines, options, NOISE)
        found = FitFinder(count, pixels, options, NOISE, device="cpu").find(lines)
        assert not lines_that_differ(found, expected).any()
        assert ((expected.flags & PeakFlag.JOINT) != 0).any(axis=1).sum() > 10


@pytest.mark.slow
def test_widths_below_a_third_of_a_pixel_are_improbable():
    assert FitSettings(width_log_sigma=np.inf, width_px=0.3).narrow_width_px == NARROW_PX
    assert FitSettings(width_log_sigma=2.0).narrow_width_px == NARROW_PX
    # Who believes in narrow lines is not contradicted.
    assert FitSettings(width_px=0.4, width_log_sigma=0.1).narrow_width_px == 0.2
    _, lines = faint_lines(0.6, 50.0, 2000, 7)
    _, model, fits = solved(lines, FREE, noise_of(50.0))
    width = np.exp(fits.parameters[fits.good, -1])
    assert model.peaks == 1
    assert (width < 0.3).mean() < 0.002
    # And bright ones tell.
    rng = np.random.default_rng(8)
    place = MIDDLE + rng.uniform(0.3, 0.7, 50)
    lines = measured(gaussian_counts(PIXELS, place, 0.3, 1e4), rng)
    _, _, fits = solved(lines, FREE, NOISE)
    assert np.median(np.exp(fits.parameters[:, -1])) == pytest.approx(0.3, abs=0.02)
