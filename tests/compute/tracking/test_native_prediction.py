"""The prediction kernel beside its definition."""

from typing import get_type_hints

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from compute.tracking.motion_model import (
    STATE_SIZE,
    ImmStates,
    MotionModels,
    combine_modes,
    mix_and_predict,
)
from compute.tracking.native.kernels import Predictor
from compute.tracking.settings import TrackerSettings

MOTIONS = ("velocity", "acceleration", "interacting")
SENSORS = 5
ACCELERATION = slice(6, 9)


def states_of(motion: MotionModels, tracks: int, seed: int) -> ImmStates:
    """Return states as tracks have them: millimetres to metres, models apart from one another."""
    rng = np.random.default_rng(seed)
    models = len(motion)
    scale = np.repeat([100.0, 1e3, 1e4], 3)
    root = rng.normal(size=(tracks, models, STATE_SIZE, STATE_SIZE)) * scale[:, None]
    root *= 10.0 ** rng.uniform(-4.0, 0.0, (tracks, 1, 1, 1))
    mean = rng.normal(size=(tracks, models, STATE_SIZE)) * scale
    bias = rng.normal(size=(tracks, models, STATE_SIZE, SENSORS)) * scale[:, None]
    states = ImmStates(
        mean, root @ root.swapaxes(-1, -2), bias, rng.dirichlet(np.ones(models), tracks)
    )
    for model, has in enumerate(motion.has_acceleration):
        if not has:
            states.mean[:, model, ACCELERATION] = 0.0
            states.covariance[:, model, ACCELERATION] = 0.0
            states.covariance[:, model, :, ACCELERATION] = 0.0
            states.bias_cross_covariance[:, model, ACCELERATION] = 0.0
    return states


@pytest.fixture(scope="module")
def predictors() -> dict[str, tuple[MotionModels, Predictor]]:
    made = {}
    for name in MOTIONS:
        motion = MotionModels.of(TrackerSettings(motion=name))
        made[name] = motion, Predictor(motion, SENSORS)
    return made


def assert_alike(found: object, wanted: object) -> None:
    """Compare to rounding: each value with the largest of its array."""
    for name in get_type_hints(type(wanted)):
        one, two = getattr(found, name), getattr(wanted, name)
        size = np.abs(two).max(initial=1.0, axis=tuple(range(1, two.ndim)), keepdims=True)
        assert one.shape == two.shape
        assert (np.abs(one - two) <= 1e-12 * size).all(), name


@given(
    st.sampled_from(MOTIONS),
    st.lists(st.just(0.0) | st.floats(1e-6, 0.5), max_size=5),
    st.integers(0, 2**32 - 1),
)
def test_kernel_predicts_and_combines_as_the_definition(
    predictors: dict[str, tuple[MotionModels, Predictor]], name: str, steps: list[float], seed: int
) -> None:
    motion, predictor = predictors[name]
    states, step_s = states_of(motion, len(steps), seed), np.array(steps)
    wanted = mix_and_predict(motion, states, step_s)
    assert_alike(predictor.predict(states, step_s), wanted)
    assert_alike(predictor.combined(states, step_s), combine_modes(motion, wanted))


@pytest.mark.parametrize("name", MOTIONS)
def test_kernel_leaves_its_input_and_takes_parts_of_arrays(
    predictors: dict[str, tuple[MotionModels, Predictor]], name: str
) -> None:
    motion, predictor = predictors[name]
    states, step_s = states_of(motion, 6, 1), np.linspace(0.0, 0.02, 6)
    before = states.rows(np.arange(6))
    whole = predictor.predict(states, step_s)
    part = predictor.predict(states.rows(slice(1, 6, 2)), step_s[1::2])
    for field in vars(states):
        assert np.array_equal(getattr(states, field), getattr(before, field))
        assert np.array_equal(getattr(part, field), getattr(whole, field)[1::2])
