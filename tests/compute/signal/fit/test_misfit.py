"""Lines of another shape than the fit's: the fit ends, and where it would with all patience."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import ndtr

import compute.signal.fit.fisher_scoring as fit_solve
from compute.signal.fit.fit_finder import FitFinder
from compute.signal.fit.fit_reference import fit_scans
from compute.signal.fit.fit_settings import CONVERGENCE_THRESHOLD_SIGMA, FitSettings
from compute.signal.peaks import PeakFlag
from compute.signal.sensor_noise import SensorNoise
from tests.compute.signal.fit.kernel_agreement import lines_that_differ

PIXELS = 96
NOISE = SensorNoise.of(20.0, 30.0, 100.0)
FREE = FitSettings(width_px=2.0, width_log_sigma=np.inf, further_peaks=False)


def disc(t):
    """Light below t of an evenly lit disc."""
    u = np.clip(t / 1.8, -1.0, 1.0)
    return 0.5 + (u * np.sqrt(1.0 - u * u) + np.arcsin(u)) / np.pi


def skewed(t):
    """Light below t of two halves of Gaussians, the right one wider."""
    left, right = 0.7, 1.6
    below, above = 2.0 * ndtr(np.minimum(t, 0.0) / left), 2.0 * ndtr(np.maximum(t, 0.0) / right)
    return (left * below + right * (above - 1.0)) / (left + right)


def core_and_halo(t):
    """Light below t of a sharp line with a wide foot."""
    return 0.7 * ndtr(t / 0.7) + 0.3 * ndtr(t / 2.0)


SHAPES = {"disc": disc, "skewed": skewed, "core and halo": core_and_halo}


def lines_of(below, electrons, width_px, seed, place=None):
    """Lines of one peak each, uint16; ``place`` are their positions, shape (L,)."""
    rng = np.random.default_rng(seed)
    if place is None:
        place = 47.0 + rng.uniform(0.0, 1.0, 120)
    right = (np.arange(PIXELS) + 0.5 - np.asarray(place)[:, None]) / width_px
    mean = electrons * (below(right) - below(right - 1.0 / width_px)) + 200.0
    counts = (rng.poisson(mean) + rng.normal(0.0, 30.0, mean.shape)) / 20.0 + 100.0
    return np.clip(np.rint(counts), 0, 65535).astype(np.uint16)


@pytest.mark.parametrize("electrons", [1e5, 1e6])
@pytest.mark.parametrize("width_px", [0.7, 1.0, 2.5])
@pytest.mark.parametrize("below", SHAPES.values(), ids=SHAPES.keys())
def test_bright_lines_of_another_shape_are_fitted(below, width_px, electrons, monkeypatch):
    """Steps that shrink by half or less leave no more than the last; they may shrink slower here.

    Ten times the last step's limit is allowed, which is by the misfit's own deviation.
    """
    lines = lines_of(below, electrons, width_px, 5)
    found = fit_scans(lines, FREE, NOISE)
    assert (found.count == 1).all()
    assert not (found.flags & PeakFlag.UNFITTED).any()
    assert (found.flags[:, 0] & PeakFlag.POOR_FIT != 0).mean() > 0.9
    kernel = FitFinder(len(lines), PIXELS, FREE, NOISE, device="cpu").find(lines)
    assert not lines_that_differ(kernel, found).any()

    monkeypatch.setattr(fit_solve, "CONVERGENCE_THRESHOLD_SIGMA", 1e-8)
    monkeypatch.setattr(fit_solve, "MAX_ITERATIONS", 1000)
    patient = fit_scans(lines, FREE, NOISE)
    assert not (patient.flags & PeakFlag.UNFITTED).any()
    off = np.abs(found.position_px - patient.position_px)[:, 0]
    misfit = np.sqrt(np.maximum(patient.reduced_chi2[:, 0], 1.0))
    assert (off <= 10.0 * CONVERGENCE_THRESHOLD_SIGMA * misfit * patient.sigma_px[:, 0]).all()


@pytest.mark.parametrize(
    ("noise", "ambient", "values"),
    [
        ((5.0, 40.0, 400.0), 405, [479, 793, 2615, 3851, 17245, 27675, 5184, 2992, 1065, 492, 466]),
        ((5.0, 40.0, 400.0), 405, [466, 551, 1782, 3119, 13676, 23427, 5560, 2481, 761, 484, 451]),
        ((50.0, 30.0, 40.0), 41, [42, 46, 55, 150, 425, 978, 199, 90, 47, 44, 42]),
    ],
)
def test_sharp_lines_with_a_foot_are_fitted(noise, ambient, values, monkeypatch):
    """Simulated lines of cameras with cylinder lenses: steps shrink by a half at a time."""
    line = np.full((1, 128), ambient, np.uint16)
    line[0, 60:71] = values
    options = FitSettings(width_log_sigma=np.inf, max_joint_peaks=1)
    sensor = SensorNoise.of(*noise)
    found = fit_scans(line, options, sensor)
    assert found.flags[0, 0] == PeakFlag.POOR_FIT
    assert not lines_that_differ(
        FitFinder(1, 128, options, sensor, device="cpu").find(line), found
    ).any()
    monkeypatch.setattr(fit_solve, "CONVERGENCE_THRESHOLD_SIGMA", 1e-8)
    monkeypatch.setattr(fit_solve, "MAX_ITERATIONS", 1000)
    patient = fit_scans(line, options, sensor)
    off = abs(found.position_px[0, 0] - patient.position_px[0, 0])
    misfit = np.sqrt(patient.reduced_chi2[0, 0])
    assert off <= 10.0 * CONVERGENCE_THRESHOLD_SIGMA * misfit * patient.sigma_px[0, 0]


@pytest.mark.parametrize("kernel", [False, True], ids=["reference", "kernel"])
def test_without_further_peaks_no_line_is_split(kernel):
    """Where with them nearly all are; the position is that of the fit of one peak alone."""
    lines = lines_of(skewed, 1e5, 2.0, 6)

    def fitted(options):
        if kernel:
            return FitFinder(len(lines), PIXELS, options, NOISE, device="cpu").find(lines)
        return fit_scans(lines, options, NOISE)

    assert (fitted(replace(FREE, further_peaks=True)).count > 1).mean() > 0.9
    found, alone = fitted(FREE), fitted(replace(FREE, max_joint_peaks=1))
    assert (found.count == 1).all()
    np.testing.assert_array_equal(found.position_px, alone.position_px)


@pytest.mark.parametrize("kernel", [False, True], ids=["reference", "kernel"])
def test_without_further_peaks_overlapping_candidates_are_fitted_together(kernel):
    """Two lines six deviations apart, which the search finds both, at their true places."""
    rng = np.random.default_rng(7)
    first = 40.0 + rng.uniform(0.0, 1.0, 200)
    half = [lines_of(ndtr, 1e5, 2.0, seed, first + 12.0 * seed).astype(np.int64) for seed in (0, 1)]
    lines = (half[0] + half[1] - 110).astype(np.uint16)
    # Ambient light and read noise are of two exposures: noise is larger than is said.
    options = replace(FREE, search=replace(FREE.search, detection_sigma=12.0))
    if kernel:
        found = FitFinder(len(lines), PIXELS, options, NOISE, device="cpu").find(lines)
    else:
        found = fit_scans(lines, options, NOISE)
    assert (found.count == 2).all()
    assert (found.flags[:, :2] & PeakFlag.JOINT != 0).all()
    error = found.position_px[:, :2] - np.stack([first, first + 12.0], axis=1)
    assert (np.abs(error) < 6.0 * found.sigma_px[:, :2]).all()
