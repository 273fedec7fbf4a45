"""A seeded part of the case: every calibration ends in the lowest minimum that is known."""

import numpy as np
import pytest

from validation.calibration_convergence.case import (
    convergence,
    distorted_tally,
    lowest,
    squares,
    tally,
)
from validation.calibration_convergence.random_devices import random_device

pytestmark = pytest.mark.slow


def test_all_of_a_part_reach_the_global_minimum() -> None:
    counted = tally(25, seed=1)
    assert counted.without == counted.beside == 25
    assert counted.below == 0


def test_distorted_devices_reach_the_minimum_beside_the_truth() -> None:
    assert distorted_tally(5, seed=1) == (5, 5)


def test_a_wider_search_is_below_the_truth() -> None:
    rng = np.random.default_rng(0)
    device = random_device(rng)
    assert (lowest(device, rng) < squares(device.models, device)).all()


def test_the_case_counts_what_it_ran() -> None:
    (table,), findings = convergence(2, 1)
    assert table.column("of") == (2, 2, 2, 1, 1)
    assert "met" in findings[0]
