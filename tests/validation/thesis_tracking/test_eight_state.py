"""The 8-state model: [6.11] to the letter, and the filter's honesty."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from compute.errors import InvalidParameter
from validation.thesis_tracking.eight_state import EightState, EightStateModel


@given(st.floats(1e-4, 2.0))
def test_transition_is_the_printed_one(t: float) -> None:
    h = t * t / 2.0
    printed = [
        [1, 0, 0, t, 0, 0, h, 0],
        [0, 1, 0, 0, t, 0, 0, h],
        [0, 0, 1, 0, 0, t, 0, 0],
        [0, 0, 0, 1, 0, 0, t, 0],
        [0, 0, 0, 0, 1, 0, 0, t],
        [0, 0, 0, 0, 0, 1, 0, 0],
        [0, 0, 0, 0, 0, 0, 1, 0],
        [0, 0, 0, 0, 0, 0, 0, 1],
    ]
    np.testing.assert_allclose(EightStateModel.transition(t), printed, rtol=1e-14)


@given(st.floats(0.001, 1.0), st.floats(0.001, 1.0))
def test_two_steps_are_one(first: float, second: float) -> None:
    model = EightStateModel(3.0, 5.0)
    later = model.transition(second)
    both = later @ model.noise(first) @ later.T + model.noise(second)
    np.testing.assert_allclose(both, model.noise(first + second), rtol=1e-9, atol=1e-12)
    assert (np.linalg.eigvalsh(both) > -1e-9 * np.abs(both).max()).all()


def test_the_filter_is_honest_on_its_own_model() -> None:
    """Normalised errors squared average their degrees of freedom, 3 and 8."""
    rng = np.random.default_rng(11)
    model, t = EightStateModel(50.0, 800.0), 0.05
    noise = np.diag([0.2, 0.2, 2.0]) ** 2
    step, drive = model.transition(t), np.linalg.cholesky(model.noise(t) + 1e-12 * np.eye(8))
    nis, nees = [], []
    for _ in range(60):
        start = rng.normal(0.0, 1.0, 8) * [0, 0, 0, 200, 200, 200, 500, 500]
        true = start
        seen = true[:3] + rng.multivariate_normal(np.zeros(3), noise)
        state = EightState.at(seen, noise, 200.0, 500.0)
        for _ in range(40):
            true = step @ true + drive @ rng.standard_normal(8)
            seen = true[:3] + rng.multivariate_normal(np.zeros(3), noise)
            state, squared = state.predicted(model, t).updated(seen, noise)
            nis.append(squared)
        error = state.mean - true
        nees.append(error @ np.linalg.solve(state.covariance, error))
    assert np.mean(nis) == pytest.approx(3.0, abs=4.5 * np.sqrt(6.0 / len(nis)))
    assert np.mean(nees) == pytest.approx(8.0, abs=4.5 * np.sqrt(16.0 / len(nees)))


def test_acceleration_along_z_is_followed_late() -> None:
    """What the ninth state would be for: the same motion along X and along Z."""
    model, t, noise = EightStateModel(1e2, 1e4), 1.0 / 30.0, 1e-4 * np.eye(3)
    state = EightState.at(np.zeros(3), noise, 10.0, 500.0)
    for k in range(1, 60):
        place = 500.0 * (k * t) ** 2 / 2.0
        state, _ = state.predicted(model, t).updated(np.array([place, 0.0, place]), noise)
    x, _, z = np.abs(state.velocity_mm_s - 500.0 * 59 * t)
    assert x < 0.1 * z
    assert state.acceleration_mm_s2[0] == pytest.approx(500.0, rel=0.05)
    assert np.isnan(state.acceleration_mm_s2[2])


def test_refused() -> None:
    with pytest.raises(InvalidParameter, match="jerk_psd is 0"):
        EightStateModel(1.0, 0.0)
