"""Closed forms of the beam search against each hypothesis's own equations."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from compute.calibration.mislabels import beam_search as search_module
from compute.calibration.mislabels.beam_search import (
    LinearisedCamera,
    _extend,
    _reduce,
    evaluate_hypotheses,
    log_posteriors,
)
from compute.calibration.mislabels.hypothesis import KNOWN_SIGMA, Evidence, Hypothesis, ScalePrior

WIDTH = 7
EXPLAINED = (
    Hypothesis(),
    Hypothesis(frozenset({3, 7, 11, 20})).with_cycle((1, 5)),
    Hypothesis(frozenset(range(10, 17))).with_cycle((1, 5, 8)),
)


def camera(seed: int, count: int, scale: ScalePrior) -> LinearisedCamera:
    rng = np.random.default_rng(seed)
    basis = np.linalg.qr(rng.standard_normal((count, WIDTH)))[0]
    fitted = rng.uniform(0.0, 60.0, count)
    sigma = rng.uniform(0.5, 2.0, count)
    readings = fitted + sigma * rng.standard_normal(count)
    evidence = Evidence(float(np.log(0.03 / 2048)), scale, WIDTH)
    return LinearisedCamera(basis, fitted, readings, sigma, evidence)


@pytest.mark.parametrize("scale", [KNOWN_SIGMA, ScalePrior(1.0, 0.3)], ids=["known", "unknown"])
@given(seed=st.integers(0, 10**6))
@settings(max_examples=5, deadline=None)
def test_each_step_scores_as_its_own_equations_do(seed: int, scale: ScalePrior) -> None:
    here = camera(seed, 24, scale)
    states = evaluate_hypotheses(here, EXPLAINED)
    more, fewer = _extend(here, states, 10_000), _reduce(here, states, 10_000)
    for found in (more, fewer):
        scores = np.array([score for score, _ in found])
        exact = log_posteriors(
            here, evaluate_hypotheses(here, [hypothesis for _, hypothesis in found])
        )
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
    hypotheses = [*EXPLAINED, *(Hypothesis(frozenset({k})) for k in range(4))]
    here = camera(5, 160, KNOWN_SIGMA)
    assert here.batch_size < len(hypotheses)
    found = _extend(here, evaluate_hypotheses(here, hypotheses), 12)
    monkeypatch.setattr(search_module, "MAX_PAIRS_PER_BATCH", 10**9)
    at_once = camera(5, 160, KNOWN_SIGMA)
    assert at_once.batch_size > len(hypotheses)
    every = {
        h: score for score, h in _extend(at_once, evaluate_hypotheses(at_once, hypotheses), 12)
    }
    assert every.keys() == {h for _, h in found}
    np.testing.assert_allclose([score for score, _ in found], [every[h] for _, h in found])
