"""Fitted peaks: what they are, that they are honest, and what becomes of lines without any."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.optimize import least_squares
from scipy.special import ndtr

from compute.errors import InvalidParameter
from compute.signal.centroid_reference import find_peaks_reference
from compute.signal.centroid_settings import CentroidSettings
from compute.signal.fit.fit_reference import fit_scans
from compute.signal.fit.fit_settings import CONVERGENCE_THRESHOLD_SIGMA, FitSettings
from compute.signal.fit.group_fit import fit_scan
from compute.signal.fit.line_spread_function import LineSpreadFunction
from compute.signal.peaks import PeakFlag
from compute.signal.sensor_noise import SensorNoise
from tests.compute.signal.synthetic_scans import (
    FULL,
    GAIN,
    NOISE,
    OFFSET,
    READ,
    gaussian_counts,
    measured,
    varied_lines,
)
from validation.joint_position_bounds import joint_position_bounds

PIXELS = 96
AMBIENT = 20.0
KNOWN = FitSettings(width_px=2.0, width_log_sigma=0.0)
FITTED = FitSettings(width_px=2.0, width_log_sigma=0.5)


def light(height, width_px=2.0):
    return height * width_px * np.sqrt(2 * np.pi) * GAIN


def scene(positions_px, heights, width_px=2.0):
    """Mean counts of lines with several peaks each; positions of shape (L, K)."""
    return sum(
        gaussian_counts(PIXELS, place, width_px, height)
        for place, height in zip(np.transpose(positions_px), heights, strict=True)
    )


def same(found, expected):
    for name in vars(found):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), name)


@pytest.mark.parametrize(
    "options",
    [
        KNOWN,
        FITTED,
        FitSettings(width_px=2.0, background="slope"),
        FitSettings(width_px=2.1, width_log_sigma=0.01),
    ],
)
def test_it_is_the_root_of_the_score(options):
    """Beside SciPy's least squares with the variances of the last model, again and again."""
    rng = np.random.default_rng(2)
    line = measured(scene([[40.3, 46.9]], [300.0, 900.0]), rng, AMBIENT)[0]
    (group,) = fit_scan(line, options, NOISE)
    pixel = group.first_px + np.arange(len(group.values))
    middle = pixel.mean()

    def mean(p):
        lines = scene([p[:2]], [1.0, 1.0], np.exp(p[4]))
        shares = [
            gaussian_counts(PIXELS, x, np.exp(p[4]), 1.0)[0] / np.exp(p[4]) / np.sqrt(2 * np.pi)
            for x in p[:2]
        ]
        assert lines.shape == (1, PIXELS)
        lit = p[2] * shares[0] + p[3] * shares[1]
        slope = p[6] * (pixel - middle) if options.background == "slope" else 0.0
        return p[5] + lit[pixel] + slope

    p = np.array([40.0, 47.0, 1500.0, 4500.0, np.log(2.0), 120.0, 0.0])
    for _ in range(20):
        sigma = np.sqrt((READ / GAIN) ** 2 + 1 / 12 + np.maximum(mean(p) - OFFSET, 0) / GAIN)

        def residual(q, sigma=sigma):
            spread = options.width_log_sigma if options.width_log_sigma > 0 else 1e-9
            held = q[6:] if options.background == "level" else [0.0]
            return np.concatenate(
                [
                    (group.values - mean(q)) / sigma,
                    [(q[4] - np.log(options.width_px)) / spread],
                    held,
                ]
            )

        p = least_squares(residual, p, x_scale="jac", xtol=1e-14, ftol=1e-14, gtol=1e-14).x
    np.testing.assert_allclose(group.position_px, p[:2], atol=1e-3 * group.sigma_px.min())
    np.testing.assert_allclose(group.light_counts, p[2:4], rtol=1e-4)
    assert group.background_counts == pytest.approx(p[5], abs=1e-3)
    assert group.width_px == pytest.approx(np.exp(p[4]), rel=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("height", [30.0, 1000.0])
@pytest.mark.parametrize("options", [KNOWN, FITTED])
def test_one_peak_is_at_the_bound_and_says_so(height, options):
    lines = 3000
    rng = np.random.default_rng(3)
    place = 47.5 + rng.uniform(0.0, 1.0, (lines, 1))
    found = fit_scans(measured(scene(place, [height]), rng, AMBIENT), options, NOISE)
    assert (found.count == 1).all()
    error = found.position_px[:, 0] - place[:, 0]
    bounds = joint_position_bounds(
        place[:50], [light(height)], AMBIENT * GAIN, PIXELS, KNOWN, NOISE
    )
    bound = np.sqrt(bounds.mean())
    # The standard error of an RMS of 3000 is 1.3 %, of the mean square 2.6 %.
    assert np.sqrt(np.mean(error**2)) < 1.03 * bound * (1 + 4 / np.sqrt(2 * lines))
    assert abs(error.mean()) < 0.02 * bound + 4 * bound / np.sqrt(lines)
    square = np.mean((error / found.sigma_px[:, 0]) ** 2)
    assert abs(square - 1.0) < 0.05 + 4 * np.sqrt(2 / lines)
    # Chi-squares of 15 to 18 degrees of freedom; the width's prior counts but takes nothing.
    assert 0.9 < found.reduced_chi2[:, 0].mean() < 1.05
    assert np.mean(found.flags != 0) < 0.005


@pytest.mark.slow
@pytest.mark.parametrize("apart", [2.0, 2.5, 4.0, 8.0])
def test_pairs_have_their_joint_covariance(apart):
    lines, height = 1500, 2000.0
    rng = np.random.default_rng(4)
    place = 40.0 + rng.uniform(0.0, 1.0, (lines, 1)) + [0.0, 2.0 * apart]
    found = fit_scans(measured(scene(place, [height, height]), rng, AMBIENT), KNOWN, NOISE)
    assert (found.count == 2).all()
    assert (found.flags[:, :2] == PeakFlag.JOINT).mean() > 0.998
    error = found.position_px[:, :2] - place
    covariance = np.stack([found.covariance(line) for line in range(lines)])
    bounds = joint_position_bounds(
        place[:50], [light(height)] * 2, AMBIENT * GAIN, PIXELS, KNOWN, NOISE
    ).mean(axis=0)
    np.testing.assert_allclose(covariance.mean(axis=0), bounds, rtol=0.05, atol=0.02 * bounds.max())
    square = np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error)
    assert abs(square.mean() - 2.0) < 0.1 + 4 * 2 / np.sqrt(lines)
    rms = np.sqrt(np.mean(error**2, axis=0))
    assert (rms < 1.05 * np.sqrt(np.diag(bounds)) * (1 + 4 / np.sqrt(2 * lines))).all()


@pytest.mark.parametrize(("apart", "height"), [(1.5, 80.0), (2.0, 40.0), (2.5, 30.0)])
def test_pairs_are_told_apart_as_soon_as_the_light_allows(apart, height):
    """Where the misfit of one line is four deviations more than chance and the criterion ask."""
    lines = 300
    rng = np.random.default_rng(15)
    place = 45.0 + rng.uniform(0.0, 1.0, (lines, 1)) + [0.0, 2.0 * apart]
    mean = scene(place, [height, height])
    one = FitSettings(width_px=2.0, width_log_sigma=0.0, max_joint_peaks=1)
    exact = np.rint(mean[:1] + AMBIENT + OFFSET).astype(np.uint16)
    (alone,) = fit_scan(exact[0], one, NOISE)
    needed = 2.0 * np.log(len(alone.values)) + KNOWN.split_margin
    misfit = alone.chi2
    assert misfit - 4.0 * 2.0 * np.sqrt(misfit) > needed
    chance = alone.dof + misfit - 4.0 * np.sqrt(2 * alone.dof + 4 * misfit)
    assert chance > KNOWN.chi2_limits()[alone.dof]
    found = fit_scans(measured(mean, rng, AMBIENT), KNOWN, NOISE)
    assert np.mean(found.count == 2) > 0.98


@pytest.mark.slow
def test_single_peaks_are_split_as_rarely_as_the_settings_say():
    lines = 10_000
    options = FitSettings(width_px=1.5, width_log_sigma=0.0, false_split_rate=1e-3)
    rng = np.random.default_rng(5)
    place = 47.5 + rng.uniform(0.0, 1.0, (lines, 1))
    pixels = measured(scene(place, [500.0], 1.5), rng, AMBIENT)
    # Only the lines' middles: the search looks at each pixel in turn.
    found = fit_scans(np.ascontiguousarray(pixels[:, 16:80]), options, NOISE)
    assert np.sum(found.count != 1) <= lines * 1e-3 + 5 * np.sqrt(lines * 1e-3)
    poor = np.sum((found.flags & PeakFlag.POOR_FIT) != 0)
    assert poor <= lines * 1e-3 + 5 * np.sqrt(lines * 1e-3)


@pytest.mark.parametrize("lines", [500, pytest.param(1500, marks=pytest.mark.slow)])
def test_saturated_peaks_are_fitted_by_their_flanks(lines):
    rng = np.random.default_rng(6)
    place = 47.5 + rng.uniform(0.0, 1.0, (lines, 1))
    pixels = measured(scene(place, [3.0 * FULL]), rng, AMBIENT, FULL)
    found = fit_scans(pixels, KNOWN, NOISE)
    assert (found.flags[:, 0] == PeakFlag.SATURATED).mean() > 0.998
    error = found.position_px[:, 0] - place[:, 0]
    square = np.mean((error / found.sigma_px[:, 0]) ** 2)
    assert abs(square - 1.0) < 0.05 + 4 * np.sqrt(2 / lines)
    assert abs(error.mean()) < 4 * error.std() / np.sqrt(lines)
    # The centre of gravity of cut tops is several times as far off.
    gravity = find_peaks_reference(pixels[:200], CentroidSettings(), NOISE).position_px[:, 0]
    assert np.std(gravity - place[:200, 0]) > 2 * error.std()


@pytest.mark.slow
@pytest.mark.parametrize("side", ["left", "right"])
def test_lines_over_the_end_are_flagged_and_not_drawn_inwards(side):
    lines = 1000
    rng = np.random.default_rng(7)
    inwards = rng.uniform(0.0, 1.0, (lines, 1))
    sign, place = (1.0, inwards) if side == "left" else (-1.0, PIXELS - 1 - inwards)
    pixels = measured(scene(place, [500.0]), rng, AMBIENT)
    found = fit_scans(pixels, KNOWN, NOISE)
    error = sign * (found.position_px[:, 0] - place[:, 0])
    fitted = (found.flags[:, 0] & PeakFlag.UNFITTED) == 0
    assert fitted.mean() > 0.99
    assert (found.flags[fitted, 0] & PeakFlag.CLIPPED != 0).all()
    square = np.mean((error / found.sigma_px[:, 0])[fitted] ** 2)
    assert abs(square - 1.0) < 0.05 + 4 * np.sqrt(2 / lines)
    centre = find_peaks_reference(pixels, CentroidSettings(), NOISE).position_px[:, 0]
    assert np.mean(sign * (centre - place[:, 0])) > 20 * abs(error[fitted].mean())


def test_each_sensor_has_its_own_shape():
    rng = np.random.default_rng(13)
    edges = np.arange(-160, 161) / 16.0
    cells = np.stack([np.diff(ndtr(edges / width)) for width in (1.2, 2.4)])[:, None]
    shape = LineSpreadFunction.from_cells(cells, edges[0], 1 / 16, unit_px=2.0)
    lines = 400
    place = 47.5 + rng.uniform(0.0, 1.0, (lines, 1))
    means = np.where(
        np.arange(lines)[:, None] % 2 == 0,
        scene(place, [1000.0], 1.2),
        scene(place, [1000.0], 2.4),
    )
    noise = SensorNoise.of([GAIN, GAIN], READ, OFFSET)
    found = fit_scans(measured(means, rng, AMBIENT), KNOWN, noise, shape)
    assert (found.count == 1).all()
    assert (found.flags == 0).mean() > 0.998
    square = np.mean(((found.position_px - place)[:, 0] / found.sigma_px[:, 0]) ** 2)
    assert abs(square - 1.0) < 0.05 + 4 * np.sqrt(2 / lines)
    # The other way round it does not fit.
    wrong = LineSpreadFunction.from_cells(cells[::-1], edges[0], 1 / 16, unit_px=2.0)
    one = FitSettings(width_px=2.0, width_log_sigma=0.0, max_joint_peaks=1)
    bad = fit_scans(measured(means, rng, AMBIENT), one, noise, wrong)
    assert (bad.flags[:, 0] & (PeakFlag.POOR_FIT | PeakFlag.UNFITTED) != 0).all()


@pytest.mark.slow
def test_uneven_pixels_are_allowed_for():
    rng = np.random.default_rng(14)
    lines, error = 1500, 0.05
    place = 47.5 + rng.uniform(0.0, 1.0, (lines, 1))
    means = scene(place, [3000.0]) * (1.0 + error * rng.standard_normal((lines, PIXELS)))
    pixels = measured(means, rng, AMBIENT)
    squares = []
    for allowed in (error, 0.0):
        options = FitSettings(
            width_px=2.0, width_log_sigma=0.0, shape_error=allowed, max_joint_peaks=1
        )
        found = fit_scans(pixels, options, NOISE)
        difference = (found.position_px[:, 0] - place[:, 0]) / found.sigma_px[:, 0]
        squares.append(np.mean(difference**2))
        poor = (found.flags[:, 0] & PeakFlag.POOR_FIT) != 0
        assert poor.mean() < 0.005 if allowed else poor.mean() > 0.9
    assert abs(squares[0] - 1.0) < 0.05 + 4 * np.sqrt(2 / lines)
    assert squares[1] > 2.0


def test_whole_lines_near_the_end_are_not_flagged():
    rng = np.random.default_rng(12)
    line = measured(scene([[4.0, PIXELS - 5.0]], [500.0, 500.0]), rng, AMBIENT)
    found = fit_scans(line, KNOWN, NOISE)
    assert found.flags[0, :2].tolist() == [0, 0]


def test_one_line_tells_what_the_batch_does_and_more():
    rng = np.random.default_rng(8)
    heights = [300.0, 3000.0, 60.0]
    noise = SensorNoise.of([GAIN, 5.0], [READ, 10.0], [OFFSET, 0.0], FULL)
    lines = measured(scene([[20.3, 26.1, 70.0]] * 2, heights), rng, AMBIENT, FULL)
    for options in (KNOWN, FITTED, FitSettings(width_px=2.0, background="slope")):
        batch = fit_scans(lines, options, noise)
        for sensor in (0, 1):
            groups = fit_scan(lines[sensor], options, noise, sensor=sensor)
            count = batch.count[sensor]
            for name in ("position_px", "sigma_px", "amplitude", "flags"):
                told = np.concatenate([getattr(group, name) for group in groups])
                np.testing.assert_array_equal(
                    told.astype(getattr(batch, name).dtype), getattr(batch, name)[sensor, :count]
                )
            reduced = np.repeat(
                [group.chi2 / group.dof for group in groups],
                [len(group.position_px) for group in groups],
            )
            np.testing.assert_array_equal(
                reduced.astype(np.float32), batch.reduced_chi2[sensor, :count]
            )
            covariance = batch.covariance(sensor)
            at = 0
            for group in groups:
                k = len(group.position_px)
                where = [group.parameters.index(f"position {n + 1}") for n in range(k)]
                own = group.covariance[np.ix_(where, where)]
                np.testing.assert_allclose(covariance[at : at + k, at : at + k], own, rtol=1e-5)
                at += k
                assert group.fitted
                assert len(group.model) == len(group.values) == len(group.residual_sigma)
                np.testing.assert_allclose(
                    group.light_electrons,
                    group.light_counts * (noise.electrons_per_count[sensor]),
                )
                assert (group.width_sigma_px == 0.0) == (options.width_log_sigma == 0.0)
                assert group.values[0] == lines[sensor, group.first_px]
    (first, *_, last) = fit_scan(lines[0], FITTED, noise)
    assert first.light_electrons == pytest.approx([light(h) for h in heights[:2]], rel=0.05)
    assert abs(last.position_px[0] - 70.0) < 5 * last.sigma_px[0]
    assert abs(first.width_px - 2.0) < 5 * first.width_sigma_px


@pytest.mark.slow
def test_a_batch_is_its_lines_one_by_one():
    lines = varied_lines(48, 128, np.random.default_rng(9))
    for options in (KNOWN, FITTED):
        batch = fit_scans(lines, options, NOISE)
        for number in range(len(lines)):
            one = fit_scans(lines[number : number + 1], options, NOISE)
            assert one.count[0] == batch.count[number]
            np.testing.assert_array_equal(one.flags[0], batch.flags[number])
            # Sums of a batch are rounded otherwise, as the processor has it: where a step is just
            # at the threshold, one of the two ends a step earlier.
            difference = np.abs(one.position_px[0] - batch.position_px[number])
            assert (
                np.nanmax(difference / one.sigma_px[0], initial=0.0) < CONVERGENCE_THRESHOLD_SIGMA
            )
            np.testing.assert_array_equal(np.isnan(one.position_px[0]), np.isnan(difference))
        found = find_peaks_reference(lines, options.search, NOISE)
        same(batch, fit_scans(lines, options, NOISE, candidates=found))


def test_too_many_peaks_for_the_room():
    rng = np.random.default_rng(10)
    place = [[20.0, 26.0, 60.0, 66.0]]
    line = measured(scene(place, [500.0, 600.0, 3000.0, 2500.0]), rng, AMBIENT)
    room = FitSettings(
        width_px=2.0, width_log_sigma=0.0, search=CentroidSettings(min_width_px=1, max_peaks=3)
    )
    found = fit_scans(line, room, NOISE)
    assert found.count[0] == 3
    np.testing.assert_allclose(found.position_px[0], [26.0, 60.0, 66.0], atol=0.2)
    assert (found.flags[0] & PeakFlag.TRUNCATED != 0).all()
    covariance = found.covariance(0)
    assert covariance[0, 1] == covariance[0, 2] == 0.0
    assert covariance[1, 2] != 0.0


def test_chains_that_are_too_long_are_marked():
    rng = np.random.default_rng(11)
    place = np.array([[10.0, 20.0, 30.0, 41.0, 51.0]])
    line = measured(scene(place, [500.0] * 5), rng, AMBIENT)
    found = fit_scans(line, KNOWN, NOISE)
    assert found.count[0] == 5
    merged = (found.flags[0, :5] & PeakFlag.MERGED) != 0
    np.testing.assert_array_equal(merged, [False, False, True, True, False])
    assert found.covariance_px2[0, 2].tolist() == [0.0, 0.0, 0.0]


@pytest.mark.parametrize("value", [0, 300, FULL, 65535])
def test_lines_of_one_value_have_no_peaks(value):
    found = fit_scans(np.full((2, 128), value, np.uint16), FITTED, NOISE)
    assert (found.count == 0).all()
    assert np.isnan(found.position_px).all()
    assert fit_scan(np.full(128, value, np.uint16), FITTED, NOISE) == ()


def test_a_hot_pixel_is_no_line_of_a_known_width():
    line = np.full(128, 120, np.uint16)
    line[50] = 3000
    (group,) = fit_scan(line, KNOWN, NOISE)
    assert (group.flags & (PeakFlag.POOR_FIT | PeakFlag.UNFITTED)).all()
    assert abs(group.position_px[0] - 50.0) < 0.5
    line[50] = FULL
    (group,) = fit_scan(line, KNOWN, NOISE)
    assert (group.flags & PeakFlag.UNFITTED).all()
    assert not group.fitted
    assert group.position_px[0] == 50.0


options = st.builds(
    FitSettings,
    search=st.builds(
        CentroidSettings,
        min_width_px=st.integers(1, 3),
        max_peaks=st.integers(1, 6),
        detection_sigma=st.sampled_from([3.0, 6.0]),
    ),
    width_px=st.floats(0.25, 16.0),
    width_log_sigma=st.sampled_from([0.0, 0.1, 0.5, np.inf]),
    reach=st.floats(2.0, 8.0),
    background=st.sampled_from(["level", "slope"]),
    shape_error=st.sampled_from([0.0, 0.05]),
    max_joint_peaks=st.integers(1, 4),
)
noises = st.builds(
    SensorNoise.of,
    st.floats(0.1, 100.0),
    st.sampled_from([0.0, 5.0, 50.0]),
    st.floats(-100.0, 1000.0),
    st.sampled_from([255, 4095, 65535]),
)
lines = st.one_of(
    st.integers(64, 200).flatmap(lambda n: arrays(np.uint16, (1, n))),
    st.integers(64, 200).flatmap(lambda n: arrays(np.uint16, (1, n), elements=st.integers(0, 300))),
    st.builds(
        lambda seed: varied_lines(8, 128, np.random.default_rng(seed))[seed % 8 : seed % 8 + 1],
        st.integers(0, 2**32 - 1),
    ),
)


@pytest.mark.slow
@settings(max_examples=150, deadline=None)
@given(lines=lines, options=options, noise=noises)
def test_any_line_gives_defined_peaks(lines, options, noise):
    with np.errstate(divide="raise", invalid="raise", over="raise"):
        found = fit_scans(lines, options, noise)
    count = int(found.count[0])
    assert count <= options.search.max_peaks
    place = found.position_px[0]
    assert np.isfinite(place[:count]).all()
    assert np.isnan(place[count:]).all()
    assert (place[:count] >= -0.5).all()
    assert (place[:count] <= lines.shape[1] - 0.5).all()
    assert (np.diff(place[:count]) >= 0.0).all()
    assert (found.sigma_px[0, :count] > 0.0).all()
    assert (found.width_px[0, :count] > 0.0).all()
    assert (found.amplitude[0, :count] > 0.0).all()
    unfitted = (found.flags[0, :count] & PeakFlag.UNFITTED) != 0
    np.testing.assert_array_equal(np.isnan(found.reduced_chi2[0, :count]), unfitted)
    assert (found.flags[0, count:] == 0).all()
    covariance = found.covariance(0)
    scale = np.sqrt(np.diag(covariance))
    assert (np.linalg.eigvalsh(covariance / np.outer(scale, scale)) > -1e-5).all()


@pytest.mark.parametrize(
    "wrong",
    [np.zeros((1, 128)), np.zeros(128, np.uint16), np.zeros((1, 63), np.uint16)],
)
def test_what_is_no_line_is_refused(wrong):
    with pytest.raises(InvalidParameter):
        fit_scans(wrong, FITTED, NOISE)


def test_candidates_of_other_lines_are_refused():
    lines = np.full((2, 128), 100, np.uint16)
    found = find_peaks_reference(lines[:1], CentroidSettings(), NOISE)
    with pytest.raises(InvalidParameter):
        fit_scans(lines, FITTED, NOISE, candidates=found)
