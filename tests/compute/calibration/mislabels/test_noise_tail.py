"""The noise's tail: its density against quadrature, its estimate against drawn errors."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm

from compute.calibration.mislabels.detector import _tails
from compute.calibration.mislabels.evaluation import SensorReadings
from compute.calibration.mislabels.hypothesis import (
    GROSS_ERROR_PROBABILITY,
    KNOWN_SIGMA,
    NORMAL_TAIL,
    OUTLIER_SIGMA,
    TAIL_SIGMA,
    Hypothesis,
    NoiseTail,
    estimate_tail,
)
from compute.calibration.mislabels.sensor_search import search_sensor_labels
from tests.compute.rig import control_points, geometry, project, rig

GROSS = 1e-5


def test_tail_holds_its_share_of_the_errors() -> None:
    tail = NoiseTail(0.07, 2.5)
    share = 2.0 * quad(lambda e: float(tail.density(np.array(e))), TAIL_SIGMA, np.inf)[0]
    assert share == pytest.approx(0.07, rel=1e-6)


@pytest.mark.parametrize("error", [3.5, -6.0, 40.0])
@pytest.mark.parametrize("width", [0.3, 2.0])
def test_density_is_that_of_the_error_as_the_others_predict_it(error: float, width: float) -> None:
    tail, sigma_px, pixels = NoiseTail(0.05, 3.0), 0.2, 2048

    def predicted(true: float) -> float:
        return float(tail.density(np.array(true)) * norm.pdf(error, true, width))

    def integral(first: float) -> float:
        last = max(abs(error), first) + 12.0 * width
        near = [x for x in (abs(error),) if first < x < last] or None
        up = quad(predicted, first, last, points=near)[0]
        return up + quad(predicted, -last, -first, points=near and [-near[0]])[0]

    gross = GROSS_ERROR_PROBABILITY / pixels * sigma_px
    log_density, large = tail.log_density(
        np.array([error]), np.array([width]), np.array([sigma_px]), pixels
    )
    total = gross + integral(TAIL_SIGMA)
    assert np.exp(log_density[0]) * sigma_px == pytest.approx(total, rel=0.05)
    assert large[0] == pytest.approx((gross + integral(OUTLIER_SIGMA)) / total, abs=0.06)


@pytest.mark.parametrize("dof", [2.0, 3.0, 5.0])
def test_tail_of_students_noise_is_found(dof: float) -> None:
    errors = np.random.default_rng(4).standard_t(dof, 20_000)
    tail = estimate_tail(errors, np.full(errors.shape, GROSS))
    true_share = np.mean(np.abs(errors) > 4.0)
    found = tail.share * (TAIL_SIGMA / 4.0) ** tail.exponent
    assert found == pytest.approx(true_share, rel=0.15)
    assert 0.6 * dof < tail.exponent < 1.1 * dof


def test_normal_noise_with_gross_errors_has_no_tail() -> None:
    errors = np.random.default_rng(5).standard_normal(300)
    errors[:4] = [900.0, -300.0, 1500.0, 600.0]
    tail = estimate_tail(errors, np.full(errors.shape, GROSS))
    assert tail.share < 0.005
    assert estimate_tail(np.zeros(0), np.zeros(0)) == NORMAL_TAIL


@pytest.mark.parametrize(
    ("gap_sigma", "tail", "exchanged"),
    [
        (6.0, NORMAL_TAIL, True),
        (6.0, NoiseTail(0.06, 2.5), False),
        (200.0, NoiseTail(0.06, 2.5), True),
    ],
)
def test_an_exchange_must_explain_its_readings_better_than_the_tail(
    gap_sigma: float, tail: NoiseTail, *, exchanged: bool
) -> None:
    points = control_points(40)
    exact = project(rig(), points)[:, 0]
    readings = exact + np.random.default_rng(3).standard_normal(40)
    gaps = np.abs(exact[:, None] - exact)
    low, high = divmod(int(np.abs(gaps - gap_sigma).argmin()), 40)
    # What an exchange leaves over is 1.5 sigma in both.
    readings[[low, high]] = exact[[high, low]] - 1.5
    data = SensorReadings(points, readings, np.ones(40), geometry(rig())[0], KNOWN_SIGMA, tail)
    found = search_sensor_labels(data)
    pair = Hypothesis().with_cycle(sorted((low, high)))
    if exchanged:
        assert found.best.hypothesis.cycles == pair.cycles
        assert found.probability(pair) > 0.9
    else:
        assert {low, high} <= found.best.hypothesis.outliers
        assert found.probability(pair) < 0.3


def test_a_sensors_tail_is_that_of_the_others() -> None:
    points, sensors = control_points(60), geometry(rig())
    exact = project(rig(), points)
    rng = np.random.default_rng(6)
    noise = np.stack([rng.standard_normal(60), rng.standard_t(2.0, 60)], axis=1)
    data = [
        SensorReadings(points, exact[:, k] + noise[:, k], np.ones(60), sensors[k], KNOWN_SIGMA)
        for k in range(2)
    ]
    normal, heavy = _tails(data, [search_sensor_labels(one) for one in data])
    drawn = float(np.mean(np.abs(noise[:, 1]) > TAIL_SIGMA))
    assert 0.4 * drawn < normal.share < 1.5 * drawn
    assert heavy.share < 0.1 * drawn
