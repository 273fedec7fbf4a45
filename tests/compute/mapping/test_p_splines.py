from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import multivariate_normal

from compute.mapping.b_splines import interpolate_corners, interpolate_function
from compute.mapping.cell_support import cell_corners, find_supported_cells, within_hull
from compute.mapping.coverage import Coverage
from compute.mapping.diagonalised_basis import DiagonalisedBasis
from compute.mapping.grid import VoxelGrid
from compute.mapping.p_splines import PenalisedProblem
from compute.mapping.penalty_grid import step_widths
from compute.mapping.penalty_selection import average, cross_validate_penalties, gcv_score
from compute.mapping.table import CorrectionTable

cells = st.tuples(*(st.integers(1, 5),) * 3)


def grid_of(counts) -> VoxelGrid:
    return VoxelGrid((-1.0, 2.0, 5.0), (0.5, 0.7, 0.3), counts)


def table_of(grid, coefficients) -> CorrectionTable:
    corners = tuple(count + 1 for count in grid.cells)
    return CorrectionTable(
        ("s",),
        "",
        grid,
        3,
        coefficients[None],
        np.zeros((1, *corners)),
        np.ones((1, *grid.cells), dtype=bool),
    )


def inside(grid, count=50, seed=0):
    low, high = np.asarray(grid.origin_mm), grid.end_mm
    return np.random.default_rng(seed).uniform(low, high, (count, 3))


@given(cells, st.integers(0, 1000))
@settings(deadline=None, max_examples=20)
def test_all_functions_together_are_the_tensor_splines(counts, seed):
    """Their sums, and the table with the coefficients made of them, are the same function."""
    grid = grid_of(counts)
    basis = DiagonalisedBasis.of(grid, 10_000)
    assert len(basis) == np.prod(np.array(counts) + 3)
    amounts = np.random.default_rng(seed).standard_normal(len(basis))
    points = inside(grid)
    table = table_of(grid, basis.coefficients(amounts))
    np.testing.assert_allclose(
        table.at(points).value_px[:, 0], basis.values(points) @ amounts, atol=1e-10
    )


@given(cells)
@settings(deadline=None, max_examples=20)
def test_the_penalty_is_that_of_the_differences_and_a_little_on_polynomials(counts):
    grid = grid_of(counts)
    basis = DiagonalisedBasis.of(grid, 10_000)
    weights = np.array([1.0, 3.0, 0.2])
    standardised = np.prod(grid.pitch_mm) ** (1.0 / 3.0)
    penalty = basis.penalty(weights)
    for number in np.random.default_rng(1).integers(0, len(basis), 8):
        one = np.zeros(len(basis))
        one[number] = 1.0
        coefficients = basis.coefficients(one)
        expected = 0.0
        for axis in range(3):
            order = min(4, counts[axis] + 2)
            scale = (standardised / grid.pitch_mm[axis]) ** (2 * order)
            expected += weights[axis] * scale * (np.diff(coefficients, order, axis) ** 2).sum()
        if (basis.function_index[number] >= [min(4, count + 2) for count in counts]).all():
            assert penalty[number] == pytest.approx(expected, rel=1e-8)
        else:
            assert penalty[number] > expected * (1.0 - 1e-8)


def test_what_costs_more_turns_more():
    basis = DiagonalisedBasis.of(grid_of((4, 4, 4)), 10_000)
    along = basis.penalty(np.ones(3))[(basis.function_index[:, 1:] == 0).all(axis=1)]
    assert (np.diff(along) >= 0.0).all()
    assert along[0] > 0.0
    # Polynomials to the third degree: all but free beside the first function that oscillates.
    assert along[3] < 0.01 * along[4]


def test_the_smoothest_functions_are_kept():
    basis = DiagonalisedBasis.of(grid_of((4, 4, 4)), 60)
    assert len(basis) == 60
    rest = DiagonalisedBasis.of(grid_of((4, 4, 4)), 10_000)
    costs = np.sort(rest.costs.sum(axis=1))
    np.testing.assert_allclose(np.sort(basis.costs.sum(axis=1)), costs[:60])


@given(cells, st.integers(0, 1000))
@settings(deadline=None, max_examples=20)
def test_a_cubic_goes_through_its_nodes(counts, seed):
    values = np.random.default_rng(seed).standard_normal([count + 1 for count in counts])
    grid = grid_of(counts)
    found = table_of(grid, interpolate_corners(values)).at(cell_corners(grid)).value_px[:, 0]
    np.testing.assert_allclose(found, values.ravel(), atol=1e-9)


def polynomial(points):
    x, y, z = (points - [-0.5, 2.5, 5.2]).T
    return 1.0 + x * y - 2.0 * z**3 + x**3 * y**2 - 0.5 * y**3 * z


def test_cubics_are_met_exactly_by_both():
    grid = grid_of((4, 3, 5))
    points = inside(grid)
    nodes = polynomial(cell_corners(grid)).reshape(5, 4, 6)
    for coefficients in (interpolate_corners(nodes), interpolate_function(grid, polynomial)):
        found = table_of(grid, coefficients).at(points).value_px[:, 0]
        np.testing.assert_allclose(found, polynomial(points), atol=1e-10)


def problem_of(count=60, seed=3, others=2, noise=0.3):
    """Samples with noise of a smooth function, in blocks of one to three."""
    rng = np.random.default_rng(seed)
    grid = grid_of((3, 3, 2))
    basis = DiagonalisedBasis.of(grid, 40)
    points = inside(grid, count, seed)
    rows = np.concatenate([basis.values(points), rng.standard_normal((count, others))], axis=1)
    samples = (np.sin(3.0 * points[:, 0]) + points[:, 1] ** 2) / noise
    samples += rng.standard_normal(count)
    sizes = np.array([3] * 10 + [2] * 10 + [1] * 10)
    whole = PenalisedProblem(
        rows.T @ rows,
        rows.T @ samples,
        float(samples @ samples),
        count,
        np.full(others, 1e-6),
        rows,
        samples,
        sizes,
    )
    return basis, whole


def test_left_out_errors_are_those_of_fits_without_the_block():
    basis, whole = problem_of()
    penalty = basis.penalty(np.ones(3))
    found = whole.solve(penalty).left_out()
    prior = np.diag(np.concatenate([penalty, whole.others_precision]))
    starts = np.cumsum(whole.sizes) - whole.sizes
    for start, size in zip(starts, whole.sizes, strict=True):
        block = np.arange(start, start + size)
        rest = np.setdiff1d(np.arange(60), block)
        rows, samples = whole.functions[rest], whole.samples[rest]
        normal = rows.T @ rows + prior
        amounts = np.linalg.solve(normal, rows.T @ samples)
        error = whole.samples[block] - whole.functions[block] @ amounts
        np.testing.assert_allclose(found.error[block], error, rtol=1e-5, atol=1e-6)
        whitened_rows = np.linalg.solve(normal, whole.functions[block].T)
        covariance = np.eye(size) + whole.functions[block] @ whitened_rows
        np.testing.assert_allclose(found.sigma[block], np.sqrt(np.diag(covariance)), rtol=1e-5)
        square = error @ np.linalg.solve(covariance, error)
        assert (found.standardised[block] ** 2).sum() == pytest.approx(square, rel=1e-4)


def test_effective_parameters_and_residuals_by_the_hat_matrix():
    basis, whole = problem_of()
    penalty = basis.penalty(np.ones(3))
    fit = whole.solve(penalty)
    prior = np.diag(np.concatenate([penalty, whole.others_precision]))
    hat = whole.functions @ np.linalg.solve(whole.gram + prior, whole.functions.T)
    rest = whole.samples - hat @ whole.samples
    assert fit.effective_parameters == pytest.approx(np.trace(hat))
    assert fit.residual_sum_of_squares == pytest.approx(rest @ rest)
    expected = 60 * (rest @ rest) / (60 - np.trace(hat)) ** 2
    assert gcv_score(fit) == pytest.approx(expected)
    np.testing.assert_allclose(
        fit.variance(whole.functions),
        np.diag(whole.functions @ np.linalg.inv(whole.gram + prior) @ whole.functions.T),
    )


def test_the_penalty_chosen_predicts_as_well_as_any():
    basis, whole = problem_of(noise=0.1)
    penalties = cross_validate_penalties(whole, basis)
    chosen = penalties.trials[penalties.best].total
    scores = [
        whole.solve(10.0**power * basis.penalty(np.ones(3)))
        .left_out()
        .deviances(known_variance=True)
        .sum()
        for power in np.arange(-8.0, 12.0, 0.25)
    ]
    # Twice the log density of all 60 samples is within 2 of the best, or better by its axes.
    assert chosen - min(scores) < 2.0
    assert chosen - max(scores) < -60.0


def test_surprise_is_the_density_of_left_out_blocks():
    basis, whole = problem_of()
    fit = whole.solve(basis.penalty(np.ones(3)))
    prior = np.diag(fit.precision)
    total = 0.0
    starts = np.cumsum(whole.sizes) - whole.sizes
    for start, size in zip(starts, whole.sizes, strict=True):
        block = np.arange(start, start + size)
        rest = np.setdiff1d(np.arange(60), block)
        rows, samples = whole.functions[rest], whole.samples[rest]
        normal = rows.T @ rows + prior
        mean = whole.functions[block] @ np.linalg.solve(normal, rows.T @ samples)
        whitened_rows = np.linalg.solve(normal, whole.functions[block].T)
        density = multivariate_normal(mean, np.eye(size) + whole.functions[block] @ whitened_rows)
        total -= 2.0 * density.logpdf(whole.samples[block]) + size * np.log(2.0 * np.pi)
    found = fit.left_out().deviances(known_variance=True)
    assert found.sum() == pytest.approx(total, rel=1e-5)
    # With an unknown factor of the variances it does not matter which one is stated.
    scaled = replace(
        whole,
        gram=9.0 * whole.gram,
        product=9.0 * whole.product,
        square=9.0 * whole.square,
        others_precision=9.0 * whole.others_precision,
        functions=3.0 * whole.functions,
        samples=3.0 * whole.samples,
    )
    other = scaled.solve(9.0 * basis.penalty(np.ones(3))).left_out()
    mine = fit.left_out()
    of_other, of_mine = (one.deviances(known_variance=False) for one in (other, mine))
    assert of_other.sum() - of_mine.sum() == pytest.approx(60 * np.log(9.0))
    assert other.scale == pytest.approx(3.0 * mine.scale)
    # Of all factors it is the most probable one.
    square = mine.standardised**2 / mine.scale**2 + 2.0 * np.log(mine.scale)
    assert (square + mine.log_variance).sum() == pytest.approx(of_mine.sum())
    for factor in (0.9, 1.1):
        square = mine.standardised**2 / (factor * mine.scale) ** 2 + 2.0 * np.log(
            factor * mine.scale
        )
        assert (square + mine.log_variance).sum() > of_mine.sum()


def test_the_average_is_the_mixture_of_the_fits():
    """Mean and variance of draws from the fits, each as often as its share says."""
    basis, whole = problem_of(noise=1.0)
    penalties = cross_validate_penalties(whole, basis)
    assert penalties.probabilities.sum() == pytest.approx(1.0)
    assert penalties.probabilities.max() < 0.9  # so that there is something to average

    def factor(fit) -> float:
        return 1.0 + fit.effective_parameters / 60.0

    found = average(whole, basis, penalties, factor)
    probabilities, means, variances, left_out = [], [], [], []
    for trial, share in zip(penalties.trials, penalties.probabilities, strict=True):
        fit = whole.solve(trial.weight * basis.penalty(trial.axes))
        probabilities.append(share)
        means.append(whole.functions @ fit.amounts)
        variances.append(factor(fit) * fit.variance(whole.functions))
        left_out.append(fit.left_out().error)
    mean, error = np.average(means, 0, probabilities), np.average(left_out, 0, probabilities)
    variance = np.average(variances + (means - mean) ** 2, 0, probabilities)
    # Shares below a thousandth of the largest are left away.
    scale = np.sqrt(variance)
    np.testing.assert_allclose((whole.functions @ found.amounts - mean) / scale, 0.0, atol=0.02)
    np.testing.assert_allclose(found.variance(whole.functions), variance, rtol=0.02)
    np.testing.assert_allclose(found.error, error, atol=0.02)
    assert (found.variance(whole.functions) > 1.02 * np.average(variances, 0, probabilities)).any()
    assert 1.0 < found.factor < 2.0


def test_penalties_that_predict_alike_have_like_shares():
    """A line of weights counts by its length, and all that correct nothing count as one."""
    basis, whole = problem_of(others=0)
    noise = 1e-3 * np.random.default_rng(1).standard_normal(60)
    nothing = replace(
        whole,
        product=whole.functions.T @ noise,
        square=float(noise @ noise),
        others_precision=np.zeros(0),
        samples=noise,
    )
    penalties = cross_validate_penalties(nothing, basis)
    assert penalties.best == int(np.argmax([trial.weight for trial in penalties.trials]))
    alike = [
        trial.total < penalties.trials[penalties.best].total + 1.0 for trial in penalties.trials
    ]
    assert (
        penalties.probabilities[np.array(alike)].max()
        < 3.0 * penalties.probabilities[penalties.best]
    )


def test_a_trial_stands_for_its_part_of_the_line():
    """Half way to its neighbours, and as far beyond the ends as to the next that would be tried."""
    equal, other = (0, 0, 0), (0, 1, 0)
    places = [(6, equal), (3, equal), (2, equal), (1, equal), (0, equal), (3, other)]
    np.testing.assert_allclose(step_widths(places), [3.0, 2.0, 1.0, 1.0, 2.0, 3.0])


def test_noise_alone_is_smoothed_away():
    basis, whole = problem_of(others=0)
    noise = np.random.default_rng(8).standard_normal(60)
    flat = PenalisedProblem(
        whole.gram,
        whole.functions.T @ noise,
        float(noise @ noise),
        60,
        np.zeros(0),
        whole.functions,
        noise,
        whole.sizes,
    )
    penalties = cross_validate_penalties(flat, basis)
    best = penalties.trials[penalties.best]
    fit = flat.solve(best.weight * basis.penalty(best.axes))
    assert fit.effective_parameters < 6.0


def test_hull_and_neighbours_decide_which_cells_are_supported():
    grid = VoxelGrid((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (6, 6, 6))
    corners = cell_corners(grid)
    everything = find_supported_cells(grid, Coverage.of(corners), 4)
    assert everything.all()
    half = corners[corners @ [1.0, 1.0, 0.0] <= 6.0]
    found = find_supported_cells(grid, Coverage.of(half), 4)
    assert found[0, 0].all()
    assert not found[5, 5].any()
    assert not found[4, 4].any()
    # Far from all but one point, inside the hull.
    sparse = np.concatenate([corners[corners[:, 0] < 2.0], [[6.0, 3.0, 3.0]]])
    assert not find_supported_cells(grid, Coverage.of(sparse), 4)[4].any()


def test_a_flat_hull_holds_nothing():
    flat = np.random.default_rng(0).uniform(0.0, 1.0, (20, 3)) * [1.0, 1.0, 0.0]
    assert not within_hull(flat, flat).any()
