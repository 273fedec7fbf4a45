"""Case random-rigs: its own projection, its options, and small runs."""

from dataclasses import replace

import numpy as np
import pytest

from compute.measurement.measurement_model import MeasurementModel
from tests.compute.rig import control_points, rig
from validation.random_rigs.case import (
    CASE,
    expected_quantile,
    mean_nees_dof,
    run_trial,
    run_trials,
)
from validation.random_rigs.rigs import random_rig, random_trial


def test_read_a_point_on_the_axis_and_one_beside_it_by_hand() -> None:
    rig = random_rig(np.random.default_rng(0), distorted=True)
    rig = replace(rig, coefficients=np.tile([0.1, 0.2, 0.0, 0.0], (rig.sensors, 1)))
    row, slit, forward = rig.axes[0]
    assert np.cross(row, slit) == pytest.approx(forward)
    # Between a tenth and a fifth of the distance to the edge: u = 0.02, v = 0.01.
    point = rig.lenses_mm[0] + 1000.0 * (forward + 0.02 * row + 0.01 * slit)
    reading = rig.read(np.array([rig.lenses_mm[0] + 500.0 * forward, point]))[:, 0]
    assert reading[0] == pytest.approx(rig.centre_px[0])
    bent = 0.02 + 0.1 * 8e-6 + 0.2 * 2e-6
    assert reading[1] == pytest.approx(rig.centre_px[0] + rig.distance_px[0] * bent)


def test_seeds_and_trials_are_options_and_seeds_change_the_rigs() -> None:
    assert CASE.options == ("seed", "trials")
    first, again, other = (random_trial(np.random.default_rng([seed, 0])) for seed in (1, 1, 2))
    assert np.array_equal(first.readings_px, again.readings_px, equal_nan=True)
    assert first.readings_px.shape != other.readings_px.shape


def test_a_rig_with_few_readings_is_calibrated_honestly_and_one_with_too_few_refused() -> None:
    rng = np.random.default_rng([1, 3])
    trial = random_trial(rng)
    few = replace(trial, control_mm=trial.control_mm[:14], readings_px=trial.readings_px[:14])
    outcome = run_trial(few, rng)
    assert outcome.nees is not None
    assert outcome.nees < 8.0
    fewer = replace(trial, control_mm=trial.control_mm[:5], readings_px=trial.readings_px[:5])
    refused = run_trial(fewer, rng)
    assert refused.nees is None
    assert refused.refusal.startswith("TooFewPoints")


def test_the_scatter_of_the_mean_is_that_of_drawn_errors() -> None:
    models, points = rig(), control_points(40)
    used, noise = np.ones((40, 4), dtype=np.bool_), np.full(4, 0.1)
    independent = mean_nees_dof(MeasurementModel.of(models), points, used, noise)
    assert independent == pytest.approx(120.0)
    # An error of the principal distances alone, far above the noise: four degrees of freedom,
    # of which three move a point.
    covariance = np.diag([10.0**2, *[0.0] * 6] * 4)
    model = MeasurementModel.of(models, covariance)
    few = mean_nees_dof(model, points, used, noise)
    rng = np.random.default_rng(1)
    jacobian, common = model.linearise(points)[1], model.common_jacobian(points)
    total = 0.01 * np.eye(4) + common @ common.transpose(0, 2, 1)
    weight = np.linalg.inv(total)
    normal = jacobian.transpose(0, 2, 1) @ weight @ jacobian
    drawn = []
    for _ in range(2000):
        error = common @ rng.standard_normal(common.shape[2]) + 0.1 * rng.standard_normal((40, 4))
        moment = np.einsum("nsi,nst,nt->ni", jacobian, weight, error)
        drawn.append(np.einsum("ni,nij,nj->", moment, np.linalg.inv(normal), moment) / 40)
    assert np.mean(drawn) == pytest.approx(3.0, abs=0.15)
    assert few == pytest.approx(18.0 / np.var(drawn), rel=0.15)
    assert expected_quantile(np.array([few]), 0.95) == pytest.approx(
        np.quantile(drawn, 0.95), rel=0.1
    )


@pytest.mark.slow
def test_random_rigs_are_calibrated_with_an_honest_covariance() -> None:
    outcomes = run_trials(24, seed=7)
    nees = [one.nees for one in outcomes if one.fewest_readings >= 8]
    assert None not in nees
    honest = np.array(nees, dtype=np.float64)
    assert 2.4 < np.median(honest) < 3.6
    assert (honest < 5.0).mean() >= 0.9
