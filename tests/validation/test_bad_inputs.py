"""Case bad-inputs: each kind is answered, and a wrong answer is counted as wrong."""

from dataclasses import replace

import numpy as np
import pytest

from validation.bad_inputs.case import CASE, false_refusals, is_right, run_kind
from validation.bad_inputs.inputs import KINDS, Kind, sound_rig


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS, ids=[kind.label for kind in KINDS])
def test_each_kind_of_bad_input_is_answered_in_its_words(kind: Kind) -> None:
    right, wrong, example = run_kind(kind, 2, seed=11)
    assert right == 2, wrong
    assert kind.honest or any(one in example for one in kind.expected)


@pytest.mark.slow
def test_no_sound_rig_is_refused() -> None:
    count, refusals = false_refusals(16, seed=12)
    assert count > 10
    assert not refusals


def test_a_sound_rig_is_no_right_answer_to_any_kind() -> None:
    """What counts as right can fail: sound readings get none of the words."""
    zeros = next(kind for kind in KINDS if kind.label == "0 for not seen")
    rng = np.random.default_rng([0, 0])
    points, readings = zeros.make(sound_rig(rng), rng)
    readings[readings == 0.0] = np.nan
    sound = replace(zeros, make=lambda _rig, _rng: (points, readings))
    right, wrong, _ = run_kind(sound, 1, seed=0)
    assert (right, len(wrong)) == (0, 1)
    assert not is_right(zeros, False, zeros.expected[0])


def test_seeds_and_trials_are_options() -> None:
    assert CASE.options == ("seed", "trials")
