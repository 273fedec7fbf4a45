"""The fit kernel on the CPU: against the reference, at the bound, honest, and never undefined."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from compute.errors import InvalidParameter
from compute.signal.centroid_reference import find_peaks_reference
from compute.signal.centroid_settings import CentroidSettings
from compute.signal.fit.fit_finder import FitFinder
from compute.signal.fit.fit_reference import fit_scans
from compute.signal.fit.fit_settings import FitSettings
from compute.signal.fit.line_spread_function import LineSpreadFunction
from compute.signal.peaks import MAX_JOINT_PEAKS, PeakFlag
from compute.signal.sensor_noise import SensorNoise
from tests.compute.signal.fit.kernel_agreement import (
    SETTINGS,
    any_noise,
    any_settings,
    any_shape,
    lines_that_differ,
    without_room,
)
from tests.compute.signal.synthetic_scans import (
    GAIN,
    NOISE,
    OFFSET,
    READ,
    gaussian_counts,
    measured,
    varied_lines,
)
from validation.joint_position_bounds import joint_position_bounds


def fitted(lines, options, noise=NOISE, shape=None, threads=None):
    finder = FitFinder(len(lines), lines.shape[1], options, noise, shape, "cpu", threads)
    return finder.find(lines)


@pytest.mark.slow
@pytest.mark.parametrize("pixels", [64, 300, 2048, 16384])
@pytest.mark.parametrize("options", SETTINGS.values(), ids=SETTINGS.keys())
def test_kernel_matches_the_reference(pixels, options):
    lines = varied_lines(48 if pixels < 4096 else 24, pixels, np.random.default_rng(pixels))
    expected = fit_scans(lines, options, NOISE)
    assert not lines_that_differ(fitted(lines, options), expected).any()
    fits = expected.flags[np.isfinite(expected.position_px)]
    assert np.any(fits & PeakFlag.UNFITTED)
    assert np.any(fits & PeakFlag.POOR_FIT)
    assert np.any(fits & PeakFlag.JOINT) or options.max_joint_peaks == 1
    assert np.any(fits & PeakFlag.TRUNCATED) or options.search.max_peaks > 3 or pixels < 300


@pytest.mark.slow
def test_kernel_matches_the_reference_with_any_settings_noise_and_shape():
    """Of lines of every kind; ten in a thousand may differ: of 9,600 with other seeds 32 did, and
    10 of these 960 would be four deviations more. (Windows wider by a thousandth: 19.)

    Where saturated pixels are left out or the content is random, a fit may need all of its steps:
    then the last digit says whether it ends within them.
    """
    differ = []
    for seed in range(24):
        rng = np.random.default_rng(seed)
        pixels = int(rng.integers(64, 1000))
        lines = varied_lines(40, pixels, rng)
        if seed % 4 == 0:
            lines = rng.choice([0, 1, 100, 130, 300, 4095, 65535], (40, pixels)).astype(np.uint16)
        options, noise = any_settings(rng), any_noise(rng)
        options = replace(options, further_peaks=seed % 3 > 0)
        shape = any_shape(rng) if seed % 2 else None
        expected = fit_scans(lines, options, noise, shape)
        differ.append(lines_that_differ(fitted(lines, options, noise, shape), expected))
    assert np.sum(differ) <= 10


def bright_lines(count, width_px, electrons, gain, rng):
    """Lines of one peak each in 64 pixels, uint16, and the positions; 20 counts of ambient."""
    noise = SensorNoise.of(gain, 5.0, 100.0)
    position = rng.uniform(25.0, 38.0, count)
    share = gaussian_counts(64, position, width_px, 1.0 / (width_px * np.sqrt(2.0 * np.pi)))
    light = rng.poisson(share * electrons + 20.0 * gain) + rng.normal(0.0, 5.0, share.shape)
    return np.rint(light / gain + 100.0).astype(np.uint16), position, noise


@pytest.mark.parametrize("electrons", [1e5, 1e6])
@pytest.mark.parametrize("width_px", [0.5, 1.0, 3.0])
def test_single_peaks_in_float32_are_as_good_as_in_float64(width_px, electrons):
    lines, _, noise = bright_lines(400, width_px, electrons, 25.0, np.random.default_rng(9))
    options = FitSettings(width_px=width_px)
    expected = fit_scans(lines, options, noise)
    assert not lines_that_differ(fitted(lines, options, noise), expected).any()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("width_px", "electrons", "read"),
    [(0.6, 1e4, 20.0), (0.6, 1e5, 5.0), (1.0, 3e3, 5.0), (1.5, 1e4, 50.0), (3.0, 1e5, 50.0)],
)
def test_single_peaks_are_at_the_bound_and_honest(width_px, electrons, read):
    """RMS error over the bound of the position alone, mean square by the stated deviation, bias.

    Five standard errors of each are allowed beyond the limits.
    """
    rng = np.random.default_rng(11)
    noise = SensorNoise.of(4.0, read, 100.0)
    count, pixels = 40_000, 64
    position = rng.uniform(25.0, 38.0, count)
    height = electrons / (width_px * np.sqrt(2.0 * np.pi))
    electrons_at = gaussian_counts(pixels, position, width_px, height) + 80.0
    light = rng.poisson(electrons_at) + rng.normal(0.0, read, electrons_at.shape)
    lines = np.clip(np.rint(light / 4.0 + 100.0), 0, 65535).astype(np.uint16)
    options = FitSettings(width_px=width_px, width_log_sigma=0.0)
    bounds = joint_position_bounds(
        position[:2000, None], [electrons], 80.0, pixels, options, noise, only_positions=True
    )
    bound = np.sqrt(bounds.mean())

    found = fitted(lines, options, noise)
    one = found.count == 1
    assert one.mean() > 0.995
    error = found.position_px[one, 0] - position[one]
    assert np.sqrt(np.mean(error**2)) < bound * (1.05 + 5.0 / np.sqrt(2.0 * count))
    square = (error / found.sigma_px[one, 0]) ** 2
    assert abs(square.mean() - 1.0) < 0.05 + 5.0 * square.std() / np.sqrt(count)
    assert abs(error.mean()) < max(0.002, 0.02 * bound) + 5.0 * bound / np.sqrt(count)
    chi2 = found.reduced_chi2[one, 0].mean()
    assert abs(chi2 - 1.0) < 0.02


@pytest.mark.slow
@pytest.mark.parametrize(
    "options", [FitSettings(width_px=2.0), FitSettings(width_px=2.0, width_log_sigma=0.0)]
)
def test_pairs_are_at_their_joint_bound_and_honest(options):
    """Two lines of 1e5 electrons, 2.5 deviations apart: within 1.2 of the bound."""
    rng = np.random.default_rng(13)
    count, pixels, width_px, electrons = 10_000, 64, 2.0, 1e5
    noise = SensorNoise.of(GAIN, READ, OFFSET)
    first = rng.uniform(25.0, 30.0, count)
    place = np.stack([first, first + 2.5 * width_px], axis=1)
    height = electrons / GAIN / (width_px * np.sqrt(2.0 * np.pi))
    counts = sum(gaussian_counts(pixels, place[:, k], width_px, height) for k in range(2))
    lines = measured(counts, rng)
    bound = joint_position_bounds(
        place[:500], [electrons] * 2, 20.0 * GAIN, pixels, options, noise
    ).mean(axis=0)

    found = fitted(lines, options, noise)
    two = found.count == 2
    assert two.mean() > 0.999
    error = found.position_px[two, :2] - place[two]
    rms = np.sqrt(np.mean(error**2, axis=0))
    assert np.all(rms < 1.2 * np.sqrt(np.diag(bound)))
    covariance = np.zeros((two.sum(), 2, 2))
    covariance[:, [0, 1], [0, 1]] = found.sigma_px[two, :2].astype(np.float64) ** 2
    covariance[:, [0, 1], [1, 0]] = found.covariance_px2[two, 0, :1]
    assert np.all(covariance[:, 0, 1] != 0.0)
    square = np.einsum("nk,nkj,nj->n", error, np.linalg.inv(covariance), error)
    # Twice what one peak may be off by, and five standard errors.
    assert abs(square.mean() - 2.0) < 0.1 + 5.0 * square.std() / np.sqrt(count)
    assert np.all(found.flags[two, :2] & PeakFlag.JOINT)


def assert_defined(found, lines, options):
    """Where a peak is counted all is finite, inside and in order; elsewhere there is nothing."""
    pixels = lines.shape[1]
    room = options.search.max_peaks
    assert found.position_px.shape == (len(lines), room)
    for line, count in enumerate(found.count.tolist()):
        assert 0 <= count <= room
        position = found.position_px[line]
        assert np.all(np.isfinite(position[:count]))
        assert np.all((position[:count] >= -0.5) & (position[:count] <= pixels - 0.5))
        assert np.all(np.diff(position[:count]) >= 0.0)
        assert np.all(np.isnan(position[count:]))
        assert np.all(found.flags[line, count:] == 0)
        assert np.all(found.covariance_px2[line, count:] == 0.0)
        sigma = found.sigma_px[line, :count]
        assert np.all(np.isfinite(sigma) & (sigma > 0.0))
        unfitted = (found.flags[line, :count] & PeakFlag.UNFITTED) != 0
        assert np.array_equal(np.isnan(found.reduced_chi2[line, :count]), unfitted)
        covariance = found.covariance(line)
        # Of rounding to float32: 1e-7 of two deviations' product, for each of four peaks.
        assert np.linalg.eigvalsh(covariance / np.outer(sigma, sigma)).min(initial=1.0) > -1e-6


any_line = st.one_of(
    arrays(np.uint16, st.tuples(st.just(2), st.integers(64, 200))),
    arrays(
        np.uint16,
        st.tuples(st.just(2), st.integers(64, 200)),
        elements=st.sampled_from([0, 1, 100, 101, 130, 300, 4095, 65534, 65535]),
        fill=st.sampled_from([0, 100, 65535]),
    ),
    st.builds(
        lambda pixels, seed: varied_lines(8, pixels, np.random.default_rng(seed)),
        st.integers(64, 1024),
        st.integers(0, 2**32),
    ),
)


# Where the width of a saturated peak is followed into another maximum of its likelihood.
@example(varied_lines(8, 1001, np.random.default_rng(637834479)), 12575, False)
@given(any_line, st.integers(0, 2**32), st.booleans())
def test_any_line_gives_defined_peaks(lines, seed, with_shape):
    rng = np.random.default_rng(seed)
    options, noise = any_settings(rng), any_noise(rng)
    found = fitted(lines, options, noise, any_shape(rng) if with_shape else None)
    assert_defined(found, lines, options)
    # What was not fitted is what the search has found.
    candidates = find_peaks_reference(lines, options.search, noise)
    for line, k in np.argwhere(found.flags & PeakFlag.UNFITTED):
        near = np.abs(candidates.position_px[line] - found.position_px[line, k])
        assert np.nanmin(near) < 1e-9


@pytest.mark.parametrize("value", [0, 300, 4095, 65535])
def test_lines_of_one_value_have_no_peaks(value):
    found = fitted(np.full((3, 128), value, np.uint16), FitSettings())
    assert found.count.tolist() == [0, 0, 0]
    assert np.isnan(found.position_px).all()


@pytest.mark.parametrize("pixels", [64, 127, 1000, 4097, 16384, 65536])
def test_peaks_at_any_place_of_lines_of_any_length(pixels):
    position = np.array([10.3, 0.5 * pixels + 0.2, pixels - 12.4])
    counts = gaussian_counts(pixels, position, 1.2, 500.0).sum(axis=0, keepdims=True)
    found = fitted(measured(counts, np.random.default_rng(1)), FitSettings())
    assert found.count.tolist() == [3]
    assert np.all(found.flags[0] == 0)
    assert np.all(np.abs(found.position_px[0, :3] - position) < 5.0 * found.sigma_px[0, :3])


def test_a_batch_smaller_than_the_room_leaves_nothing_behind():
    lines = varied_lines(48, 512, np.random.default_rng(5))
    options = without_room(FitSettings(), 4)
    expected = fitted(lines, options)
    finder = FitFinder(48, 512, options, NOISE, device="cpu")
    for count in (7, 48, 1, 0, 48):
        found = finder.find(lines[:count])
        assert len(found) == count
        for name, values in vars(found).items():
            np.testing.assert_array_equal(values, getattr(expected, name)[:count], name)


@pytest.mark.slow
def test_threads_and_batches_change_nothing():
    """By a batch that is large enough for two threads, whose parts begin with sensor 0."""
    lines = np.tile(varied_lines(60, 1024, np.random.default_rng(6)), (6, 1))
    noise = any_noise(np.random.default_rng(7))
    shape = any_shape(np.random.default_rng(8))
    one = fitted(lines, FitSettings(), noise, shape, threads=1)
    three = fitted(lines, FitSettings(), noise, shape, threads=3)
    alone = fitted(lines[:60], FitSettings(), noise, shape, threads=1)
    for name, values in vars(one).items():
        np.testing.assert_array_equal(getattr(three, name), values, name)
        np.testing.assert_array_equal(getattr(alone, name), values[:60], name)


def test_lines_take_the_noise_and_the_shape_of_their_sensor_in_turn():
    """The second sensor sees nothing for noise; shapes of the odd ones lie a width to the right."""
    counts = gaussian_counts(256, 100.3, 2.0, 600.0)
    lines = np.repeat(measured(counts, np.random.default_rng(6)), 8, axis=0)
    noise = SensorNoise.of(GAIN, [READ, 100.0 * READ, READ, READ], OFFSET)
    even = LineSpreadFunction.gaussian()
    steps = round(1.0 / even.step)
    odd_edge = np.roll(even.cumulative, steps, axis=2)
    odd_edge[..., :steps] = 0.0
    shape = LineSpreadFunction(
        np.concatenate([even.cumulative, odd_edge]),
        np.concatenate([even.density, np.roll(even.density, steps, axis=2)]),
        even.first,
        even.step,
    )
    options = FitSettings(width_px=2.0, width_log_sigma=0.0)
    found = fitted(lines, options, noise, shape)
    assert found.count.tolist() == [1, 0, 1, 1, 1, 0, 1, 1]
    expected = np.array([100.3, 100.3, 98.3] * 2)
    one = found.count == 1
    assert np.all(np.abs(found.position_px[one, 0] - expected) < 5.0 * found.sigma_px[one, 0])


def test_the_brightest_stay_where_splits_leave_no_room():
    """Three pairs that the search takes for three peaks: six, of which five have room."""
    pixels, width = 200, 2.0
    place = np.array([40.0, 44.5, 100.0, 104.5, 160.0, 164.5])
    height = np.array([900.0, 800.0, 300.0, 500.0, 700.0, 600.0])
    counts = sum(gaussian_counts(pixels, place[k], width, height[k]) for k in range(len(place)))
    lines = measured(counts, np.random.default_rng(3), full=65535)
    options = without_room(FitSettings(width_px=width, width_log_sigma=0.0), 5)
    found = fitted(lines, options)
    expected = fit_scans(lines, options, NOISE)
    assert found.count.tolist() == [5]
    assert np.all(found.flags[0] & PeakFlag.TRUNCATED)
    assert not lines_that_differ(found, expected).any()
    np.testing.assert_allclose(found.position_px[0], np.delete(place, 2), atol=0.5)
    # The third, whose neighbour has gone, is correlated with none.
    assert (found.covariance_px2[0, :, 0] != 0.0).tolist() == [True, False, False, True, False]
    assert np.all(found.covariance_px2[0, :, 1:] == 0.0)


def test_covariances_are_with_the_next_peaks_of_the_group():
    pixels, width = 128, 1.5
    place = np.array([40.0, 45.0, 50.0, 55.0])
    counts = sum(gaussian_counts(pixels, x, width, 800.0) for x in place)
    lines = measured(counts, np.random.default_rng(4), full=65535)
    found = fitted(lines, FitSettings(width_px=width))
    assert found.count.tolist() == [MAX_JOINT_PEAKS]
    np.testing.assert_array_equal(
        found.covariance_px2[0, :MAX_JOINT_PEAKS] != 0.0,
        [[True, True, True], [True, True, False], [True, False, False], [False] * 3],
    )
    assert np.all(np.linalg.eigvalsh(found.covariance(0)) > 0.0)


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        (np.zeros((2, 256), np.int16), "int16"),
        (np.zeros((2, 255), np.uint16), r"\(2, 255\)"),
        (np.zeros((5, 256), np.uint16), r"\(5, 256\).*at most 4"),
    ],
)
def test_wrong_lines_are_refused_with_the_reason(lines, words):
    finder = FitFinder(4, 256, FitSettings(), NOISE, device="cpu")
    with pytest.raises(InvalidParameter, match=words):
        finder.find(lines)


@pytest.mark.parametrize(
    ("lines", "pixels", "device", "words"),
    [(0, 256, "cpu", "scans is 0"), (4, 63, "cpu", "63 pixels"), (4, 256, "abacus", "'abacus'")],
)
def test_a_finder_that_cannot_be_is_refused_with_the_reason(lines, pixels, device, words):
    with pytest.raises(InvalidParameter, match=words):
        FitFinder(lines, pixels, FitSettings(), NOISE, device=device)


def test_candidates_are_those_of_the_search():
    """With every fit refused for want of pixels, what is left is the search's own."""
    lines = varied_lines(64, 400, np.random.default_rng(12))
    options = FitSettings(search=CentroidSettings(detection_sigma=4.0), reach=2.0, width_px=0.25)
    noise = SensorNoise.of(GAIN, READ, OFFSET, 1)
    found = fitted(lines, options, noise)
    candidates = find_peaks_reference(lines, options.search, noise)
    assert candidates.count.sum() > 50
    np.testing.assert_array_equal(found.count, candidates.count)
    assert np.all(found.flags[found.flags != 0] & PeakFlag.UNFITTED)
    np.testing.assert_allclose(found.position_px, candidates.position_px, rtol=0, atol=1e-9)
    np.testing.assert_allclose(found.sigma_px, candidates.sigma_px, rtol=1e-5)
