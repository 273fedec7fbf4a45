"""The fit kernel on CUDA against the reference and the CPU; needs CUDA, and no plugin of pytest."""

import numpy as np
import pytest

from compute.signal.fit.fit_finder import FitFinder
from compute.signal.fit.fit_reference import fit_scans
from compute.signal.fit.fit_settings import FitSettings
from compute.signal.peaks import PeakFlag
from tests.compute.signal.fit.kernel_agreement import (
    SETTINGS,
    any_noise,
    any_settings,
    any_shape,
    lines_that_differ,
    without_room,
)
from tests.compute.signal.synthetic_scans import (
    FULL,
    NOISE,
    gaussian_counts,
    measured,
    varied_lines,
)


@pytest.fixture(scope="module")
def device():
    import warp as wp

    if not wp.is_cuda_available():
        pytest.skip("no CUDA device")
    return "cuda:0"


@pytest.mark.parametrize("pixels", [64, 300, 2048, 16384])
@pytest.mark.parametrize("options", SETTINGS.values(), ids=SETTINGS.keys())
def test_matches_the_reference(device, pixels, options):
    lines = varied_lines(48, pixels, np.random.default_rng(pixels))
    found = FitFinder(48, pixels, options, NOISE, device=device).find(lines)
    assert not lines_that_differ(found, fit_scans(lines, options, NOISE)).any()


@pytest.mark.parametrize("seed", range(24))
def test_gives_what_the_cpu_gives(device, seed):
    """To the bit: both round alike."""
    rng = np.random.default_rng(seed)
    pixels = int(rng.integers(64, 3000))
    lines = varied_lines(200, pixels, rng)
    if seed % 4 == 0:
        lines = rng.integers(0, 65536, (200, pixels)).astype(np.uint16)
    options, noise = any_settings(rng), any_noise(rng)
    shape = any_shape(rng) if seed % 2 else None
    found = FitFinder(200, pixels, options, noise, shape, device).find(lines)
    expected = FitFinder(200, pixels, options, noise, shape, "cpu").find(lines)
    for name, values in vars(expected).items():
        np.testing.assert_array_equal(getattr(found, name), values, name)


@pytest.mark.parametrize("spread", [0.0, 2.0])
def test_faint_and_overlapping_lines_give_what_the_cpu_gives(device, spread):
    """To the bit, with models copied before they are fitted; so many that a warp takes several."""
    rng = np.random.default_rng(31)
    counts = np.zeros((12_000, 128))
    for chance in (0.9, 0.5):
        heights = np.where(rng.random(len(counts)) < chance, 10 ** rng.uniform(1, 4, 12_000), 0.0)
        places, widths = rng.uniform(-3, 131, 12_000), rng.uniform(0.5, 3.0, 12_000)
        counts += gaussian_counts(128, places, widths, heights)
    lines = measured(counts, rng, full=FULL)
    options = without_room(FitSettings(width_px=1.2, width_log_sigma=spread), 4)
    found = FitFinder(len(lines), 128, options, NOISE, device=device).find(lines)
    expected = FitFinder(len(lines), 128, options, NOISE, device="cpu").find(lines)
    for name, values in vars(expected).items():
        np.testing.assert_array_equal(getattr(found, name), values, name)
    fits = expected.flags[np.isfinite(expected.position_px)]
    assert np.mean((fits & PeakFlag.JOINT) != 0) > 0.1


def test_batches_of_any_size_one_after_another(device):
    lines = varied_lines(200, 512, np.random.default_rng(5))
    options = without_room(FitSettings(), 4)
    expected = FitFinder(200, 512, options, NOISE, device="cpu").find(lines)
    finder = FitFinder(200, 512, options, NOISE, device=device)
    for count in (200, 7, 1, 0, 33, 200):
        found = finder.find(lines[:count])
        assert len(found) == count
        for name, values in vars(expected).items():
            np.testing.assert_array_equal(getattr(found, name), values[:count], name)


def test_many_lines_give_the_same_each_time(device):
    """So many that a warp takes several lines."""
    block = varied_lines(100, 256, np.random.default_rng(8))
    lines = np.tile(block, (400, 1))
    finder = FitFinder(len(lines), 256, FitSettings(), NOISE, device=device)
    found = finder.find(lines)
    few = FitFinder(100, 256, FitSettings(), NOISE, device=device).find(block)
    for name, values in vars(few).items():
        whole = getattr(found, name)
        np.testing.assert_array_equal(whole, np.tile(values, (400, *[1] * (values.ndim - 1))), name)
    again = finder.find(lines)
    np.testing.assert_array_equal(again.position_px, found.position_px)
