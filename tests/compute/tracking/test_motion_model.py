"""Motion models: exact for any time step, and probabilities that stay probabilities."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from compute.tracking.motion_model import MotionModels, ca_transition, cv_transition
from compute.tracking.settings import TrackerSettings

TIMES = st.floats(1e-4, 2.0)


@given(first=TIMES, second=TIMES)
@pytest.mark.parametrize("step", [cv_transition, ca_transition])
def test_two_steps_are_one(step: object, first: float, second: float) -> None:
    assert callable(step)
    f1, q1 = step(first, 3.0)
    f2, q2 = step(second, 3.0)
    both, noise = step(first + second, 3.0)
    assert np.allclose(f2 @ f1, both, rtol=1e-12, atol=1e-14)
    assert np.allclose(f2 @ q1 @ f2.T + q2, noise, rtol=1e-9, atol=1e-14)


@given(t=st.floats(1e-2, 2.0))
def test_noise_is_the_integral_of_white_noise(t: float) -> None:
    """Van Loan's matrix exponential, an independent way to the same integral."""
    for step, order in ((cv_transition, 2), (ca_transition, 3)):
        drift = np.diag(np.ones(order - 1), 1)
        white = np.zeros((order, order))
        white[-1, -1] = 7.0
        whole = expm(np.block([[-drift, white], [np.zeros_like(drift), drift.T]]) * t)
        transition = whole[order:, order:].T
        own_transition, own_noise = step(t, 7.0)
        assert np.allclose(own_transition[:order, :order], transition)
        assert np.allclose(own_noise[:order, :order], transition @ whole[:order, order:])


@given(first=TIMES, second=TIMES)
def test_switching_over_two_times_is_switching_over_their_sum(first: float, second: float) -> None:
    models = MotionModels.of(TrackerSettings())
    one, two, both = models.mode_transition_probabilities(np.array([first, second, first + second]))
    assert np.allclose(one @ two, both)
    assert np.allclose(both.sum(axis=1), 1.0)
    assert (both > 0.0).all()
    soon = models.mode_transition_probabilities(np.array([1e-6]))[0]
    assert soon[0, 1] == pytest.approx(1e-6 / models.mean_sojourn_s, rel=1e-4)
