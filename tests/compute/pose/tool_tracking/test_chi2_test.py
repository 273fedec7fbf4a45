"""Squares of several exposures: what they share is not counted against a tool, what is wrong is."""

import numpy as np
import pytest

from compute.pose.tool_tracking.tool_track import ExposureResiduals, chi2_test
from compute.reconstruction.triangulation import chi2_limit
from tests.compute.pose.motions import check_mean

PROBABILITY = 1e-4
NOTHING = np.zeros(4, dtype=np.intp)


def exposures(
    rng: np.random.Generator, shared: float, bent: float = 0.0
) -> list[ExposureResiduals]:
    """Six exposures of four readings, whose unit variance is to a share that of one error."""
    common = np.full((24, 1), np.sqrt(shared))
    error = rng.standard_normal(1)
    found = []
    for first in range(0, 24, 4):
        jacobian = common[first : first + 4]
        # Within an exposure the innovations are white.
        root = np.linalg.cholesky(np.eye(4) - jacobian @ jacobian.T + 1e-12 * np.eye(4))
        value = root @ rng.standard_normal(4) + jacobian @ error
        value[0] += bent * (first == 8)
        sum_of_squares = float(value @ value)
        found.append(
            ExposureResiduals(sum_of_squares, 4, NOTHING, np.column_stack([value, jacobian]))
        )
    return found


def test_what_exposures_share_is_no_misfit() -> None:
    rng = np.random.default_rng(3)
    plain = together = 0
    for _ in range(1500):
        some = exposures(rng, 0.24)
        sum_of_squares, count, limit = chi2_test(some, PROBABILITY)
        assert count == 24
        assert limit == chi2_limit(24, PROBABILITY)
        plain += sum(one.sum_of_squares for one in some) > limit
        together += sum_of_squares > limit
    # One calibration in some hundreds would be refused for good.
    assert plain >= 3
    assert together <= 2


def test_together_they_are_a_chi_square() -> None:
    rng = np.random.default_rng(4)
    values = []
    for _ in range(300):
        some = exposures(rng, 0.2)
        # A limit that everything exceeds: the squares are always those of all together.
        sum_of_squares = chi2_test(some, 1.0 - 1e-9)[0]
        alone = sum(one.sum_of_squares for one in some)
        assert sum_of_squares <= alone
        values.append(sum_of_squares)
    # The smaller of the two is taken.
    assert np.mean(values) < 24.5
    check_mean(values, 24.0, slack=0.15)


def test_a_misfit_stays_one() -> None:
    rng = np.random.default_rng(5)
    for _ in range(50):
        sum_of_squares, _, limit = chi2_test(exposures(rng, 0.2, bent=12.0), PROBABILITY)
        assert sum_of_squares > limit


def test_readings_that_were_left_out_count_as_they_are() -> None:
    some = [ExposureResiduals(25.0, 1, NOTHING), ExposureResiduals(4.0, 4, NOTHING)]
    sum_of_squares, count, limit = chi2_test(some, PROBABILITY)
    assert (sum_of_squares, count) == (29.0, 5)
    assert limit == pytest.approx(chi2_limit(5, PROBABILITY))
