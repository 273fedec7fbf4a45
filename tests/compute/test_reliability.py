"""Reliability of least squares beside its definitions, written out, and the theory's power."""

import numpy as np
import pytest
from scipy import stats

from compute.reliability import POWER, check_readings, noncentrality


@pytest.mark.parametrize("dof", [1, 2, 5, 10])
@pytest.mark.parametrize("significance", [1e-4, 0.01])
def test_noncentrality_has_the_power_that_scipy_gives_it(dof: int, significance: float) -> None:
    limit = stats.chi2.isf(significance, dof)
    power = stats.ncx2.sf(limit, dof, noncentrality(dof, significance))
    assert power == pytest.approx(POWER, abs=1e-6)


def test_no_redundancy_finds_nothing() -> None:
    assert noncentrality(0, 1e-4) == np.inf


def test_correlated_readings_are_tested_as_baarda_defines_it() -> None:
    rng = np.random.default_rng(4)
    jacobian, residual = rng.standard_normal((7, 3)), rng.standard_normal(7)
    factor = rng.standard_normal((7, 7))
    covariance = factor @ factor.T + np.eye(7)
    inverse = np.linalg.inv(covariance)
    normal = jacobian.T @ inverse @ jacobian
    residual = residual - jacobian @ np.linalg.solve(normal, jacobian.T @ inverse @ residual)
    q = inverse - inverse @ jacobian @ np.linalg.solve(normal, jacobian.T @ inverse)
    whitening = np.linalg.inv(np.linalg.cholesky(covariance))
    found = check_readings(jacobian[None], residual[None], whitening[None])
    assert found.normalised[0] == pytest.approx(inverse @ residual / np.sqrt(np.diag(q)))
    assert found.sigma_px[0] == pytest.approx(1.0 / np.sqrt(np.diag(q)))
    assert found.influence[0] == pytest.approx(np.linalg.solve(normal, jacobian.T @ inverse))


def test_redundancy_numbers_of_equal_readings_sum_up_to_the_degrees_of_freedom() -> None:
    jacobian = np.random.default_rng(5).standard_normal((1, 9, 6))
    found = check_readings(jacobian, np.zeros((1, 9)), 4.0 * np.eye(9)[None])
    assert found.redundancy.sum() == pytest.approx(3.0)


def test_a_reading_that_nothing_checks_has_no_residual_and_an_infinite_sigma() -> None:
    jacobian = np.array([[[1.0, 0.0], [1.0, 0.0], [0.0, 1.0]]])
    found = check_readings(jacobian, np.array([[0.1, -0.1, 0.0]]), np.eye(3)[None])
    assert found.sigma_px[0, 2] == np.inf
    assert found.normalised[0] == pytest.approx([0.1 * np.sqrt(2), -0.1 * np.sqrt(2), 0.0])
