"""Noise of readings by an integral of its own: quadrature over all unknowns, and plain limits."""

import numpy as np
import pytest
from scipy.stats import norm

from compute.calibration.single_sensor.reading_noise import (
    GRID_MARGIN,
    NOISE_SCATTERS,
    PRIOR_LOG_SIGMA,
    PRIOR_NOISE_PX,
    estimate_noise,
)


def test_many_residuals_give_their_own_standard_deviation_whatever_the_prior() -> None:
    rng = np.random.default_rng(1)
    true = np.array([0.003, 0.04, 2.5])
    residuals = true * rng.standard_normal((4000, 3))
    found = estimate_noise(residuals, np.ones((4000, 3), dtype=np.bool_), np.full(3, 4000.0))
    assert found.sigma_px == pytest.approx(residuals.std(axis=0), rel=0.01)
    assert found.geometric_px == pytest.approx(found.sigma_px, rel=0.01)


def test_no_residuals_give_the_prior() -> None:
    used = np.zeros((3, 1), dtype=np.bool_)
    found = estimate_noise(np.ones((3, 1)), used, np.array([1e-9]))
    assert found.log_evidence == pytest.approx(0.0, abs=0.02)
    # The mean over the three scatters of exp(2 s^2), with the prior's own, cut at the grid's end.
    variances = [PRIOR_LOG_SIGMA**2 + scatter**2 for scatter in NOISE_SCATTERS]
    whole = PRIOR_NOISE_PX * np.sqrt(np.mean(np.exp(2.0 * np.array(variances))))
    assert PRIOR_NOISE_PX < found.sigma_px[0] <= whole
    assert found.geometric_px[0] == pytest.approx(PRIOR_NOISE_PX, rel=0.1)


def test_few_residuals_give_the_posterior_by_drawing() -> None:
    """Importance sampling from the prior: device, scatter and sensors are drawn, not integrated."""
    rng = np.random.default_rng(5)
    residuals = np.array([[0.1, -0.4], [0.3, 0.2], [-0.2, 0.9], [0.05, 0.3], [0.1, np.nan]])
    used = np.isfinite(residuals)
    other = np.where(used, np.linspace(0.05, 0.3, 10).reshape(5, 2), 1.0)
    dof = np.array([2.5, 1.5])
    found = estimate_noise(np.nan_to_num(residuals), used, dof, other)
    draws = 400_000
    device = np.log(PRIOR_NOISE_PX) + PRIOR_LOG_SIGMA * rng.standard_normal(draws)
    scatter = rng.choice(NOISE_SCATTERS, draws)
    sigma = np.exp(device[:, None] + scatter[:, None] * rng.standard_normal((draws, 2)))
    log_weight = np.zeros(draws)
    for row in range(2):
        here = used[:, row]
        total = np.sqrt(sigma[:, row, None] ** 2 + other[here, row] ** 2)
        squares = (residuals[here, row] / total) ** 2
        share = dof[row] / here.sum()
        log_weight -= 0.5 * squares.sum(axis=1) + share * np.log(total).sum(axis=1)
    # No sensor is noisier than this: four times what the prior or its own residuals say.
    own = np.sqrt(np.nansum(residuals**2, axis=0) / dof).max()
    largest = GRID_MARGIN * max(PRIOR_NOISE_PX * np.exp(2.0 * PRIOR_LOG_SIGMA), own)
    weight = np.exp(log_weight) * (sigma < largest).all(axis=1)
    expected = np.sqrt(weight @ sigma**2 / weight.sum())
    assert found.sigma_px == pytest.approx(expected, rel=0.03)
    assert found.log_evidence == pytest.approx(np.log(weight.mean()), abs=0.02)
    geometric = np.exp(weight @ np.log(sigma) / weight.sum())
    assert found.geometric_px == pytest.approx(geometric, rel=0.02)


def test_a_sensor_with_few_residuals_takes_the_noise_of_sensors_that_agree() -> None:
    rng = np.random.default_rng(3)
    residuals = 0.05 * rng.standard_normal((200, 4))
    used = np.ones((200, 4), dtype=np.bool_)
    used[1:, 3] = False
    residuals[0, 3] = 0.05
    dof = used.sum(axis=0).astype(np.float64)
    alone = estimate_noise(residuals[:, 3:], used[:, 3:], dof[3:]).sigma_px[0]
    with_others = estimate_noise(residuals, used, dof).sigma_px[3]
    assert with_others == pytest.approx(0.05, rel=0.2)
    assert alone > 1.5 * with_others
    # Sensors that differ do not lend theirs.
    residuals[:, 0] *= 20.0
    residuals[:, 1] /= 20.0
    assert estimate_noise(residuals, used, dof).sigma_px[3] > 1.5 * with_others


def test_noise_below_the_points_uncertainty_stays_near_the_prior() -> None:
    rng = np.random.default_rng(4)
    other = np.full((30, 2), 5.0)
    residuals = norm.rvs(scale=5.0, size=(30, 2), random_state=rng)
    used = np.ones((30, 2), dtype=np.bool_)
    found = estimate_noise(residuals, used, np.full(2, 20.0), other)
    assert 0.5 * PRIOR_NOISE_PX < found.geometric_px.min() < 3.0 * PRIOR_NOISE_PX
