"""The closed forms of the search are what each explanation's own equations say."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from compute.calibration.labels import linear_camera
from compute.calibration.labels.evidence import KNOWN, Evidence, ScalePrior
from compute.calibration.labels.hypothesis import Hypothesis
from compute.calibration.labels.linear_camera import LinearCamera, score_of, work_out
from compute.calibration.labels.linear_search import _fewer, _more

WIDTH = 7
EXPLAINED = (
    Hypothesis(),
    Hypothesis(frozenset({3, 7, 11, 20})).with_cycle((1, 5)),
    Hypothesis(frozenset(range(10, 17))).with_cycle((1, 5, 8)),
)


def camera(seed: int, count: int, scale: ScalePrior) -> LinearCamera:
    rng = np.random.default_rng(seed)
    basis = np.linalg.qr(rng.standard_normal((count, WIDTH)))[0]
    fitted = rng.uniform(0.0, 60.0, count)
    sigma = rng.uniform(0.5, 2.0, count)
    readings = fitted + sigma * rng.standard_normal(count)
    return LinearCamera(basis, fitted, readings, sigma, Evidence(2048, scale, WIDTH))


@pytest.mark.parametrize("scale", [KNOWN, ScalePrior(1.0, 0.3)], ids=["known", "unknown"])
@given(seed=st.integers(0, 10**6))
@settings(max_examples=5, deadline=None)
def test_each_step_scores_as_its_own_equations_do(seed: int, scale: ScalePrior) -> None:
    here = camera(seed, 24, scale)
    states = work_out(here, EXPLAINED)
    more, fewer = _more(here, states, 10_000), _fewer(here, states, 10_000)
    for found in (more, fewer):
        scores = np.array([score for score, _ in found])
        exact = score_of(here, work_out(here, [hypothesis for _, hypothesis in found]))
        told = np.isfinite(scores)
        np.testing.assert_allclose(scores[told], exact[told], rtol=1e-9, atol=1e-7)
    free = 24 - np.array([0, 6, 10])
    steps = {hypothesis for score, hypothesis in more if np.isfinite(score)}
    assert len(steps) == sum(n + n * (n - 1) // 2 for n in free)
    # One wrong reading fewer, two as a pair, or the cycle undone.
    wrong = np.array([0, 4, 7])
    assert len({h for _, h in fewer}) == sum(wrong + wrong * (wrong - 1) // 2) + 2


def test_many_readings_are_worked_out_in_parts_with_the_same_outcome(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    explained = [*EXPLAINED, *(Hypothesis(frozenset({k})) for k in range(4))]
    here = camera(5, 160, KNOWN)
    assert here.together < len(explained)
    found = _more(here, work_out(here, explained), 12)
    monkeypatch.setattr(linear_camera, "TOGETHER", 10**9)
    at_once = camera(5, 160, KNOWN)
    assert at_once.together > len(explained)
    every = {h: score for score, h in _more(at_once, work_out(at_once, explained), 12)}
    assert every.keys() == {h for _, h in found}
    np.testing.assert_allclose([score for score, _ in found], [every[h] for _, h in found])
