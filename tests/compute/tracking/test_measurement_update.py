"""The filter: beside batch least squares, with the calibration's error, and one soft reading."""

import numpy as np
from numpy.typing import NDArray

from compute.tracking.measurement_update import Innovation, PdaMixture, joint_update, pda_update
from compute.tracking.motion_model import ImmStates, MotionModels, combine_modes, mix_and_predict
from compute.tracking.settings import TrackerSettings

Array = NDArray[np.float64]

ONE_MODEL = MotionModels.of(TrackerSettings(motion="acceleration", jerk_psd=1e5))
SENSORS = 4


def start(models: int = 1, sensors: int = SENSORS) -> ImmStates:
    covariance = np.diag([25.0] * 3 + [1e4] * 3 + [1e6] * 3)
    return ImmStates(
        np.zeros((1, models, 9)),
        np.broadcast_to(covariance, (1, models, 9, 9)).copy(),
        np.zeros((1, models, 9, sensors)),
        np.full((1, models), 1.0 / models),
    )


def innovation(jacobian: Array, used: NDArray[np.bool_], bias: Array | None = None) -> Innovation:
    sensors = len(jacobian)
    both = np.zeros((sensors, sensors)) if bias is None else bias
    return Innovation.of(used[None], jacobian[None], np.full((1, sensors), 0.01), both[None])


def test_filter_is_the_batch_least_squares_of_the_same_problem() -> None:
    """All states of all frames at once, weighed, give the same last state and covariance."""
    rng = np.random.default_rng(5)
    frames, step = 12, 0.02
    slopes = rng.standard_normal((frames, SENSORS, 3))
    used = rng.random((frames, SENSORS)) < 0.7
    readings = rng.standard_normal((frames, SENSORS))
    states = start()
    transition, noise = (part[0, 0] for part in ONE_MODEL.transitions(np.array([step])))
    rows, right = [], []

    def equation(block: Array, value: Array, covariance: Array) -> None:
        half = np.linalg.inv(np.linalg.cholesky(covariance))
        rows.append(half @ block)
        right.append(half @ value)

    for frame in range(frames):
        if frame:
            states = mix_and_predict(ONE_MODEL, states, np.array([step]))
        place = np.zeros((9, 9 * frames))
        place[:, 9 * frame : 9 * frame + 9] = np.eye(9)
        if frame == 0:
            equation(place, np.zeros(9), start().covariance[0, 0])
        else:
            before = np.zeros_like(place)
            before[:, 9 * (frame - 1) : 9 * frame] = transition
            # White jerk drives three of nine combinations only together; a little makes it regular.
            equation(place - before, np.zeros(9), noise)
        expected = np.einsum("si,mi->ms", slopes[frame], states.mean[0, :, :3])
        difference = np.where(used[frame], readings[frame] - expected, 0.0)[None]
        states, _, _ = joint_update(states, innovation(slopes[frame], used[frame]), difference)
        seen = np.flatnonzero(used[frame])
        if len(seen):
            equation(
                slopes[frame][seen] @ place[:3], readings[frame][seen], 0.01 * np.eye(len(seen))
            )
    matrix, vector = np.concatenate(rows), np.concatenate(right)
    solution = np.linalg.lstsq(matrix, vector, rcond=None)[0]
    covariance = np.linalg.inv(matrix.T @ matrix)[-9:, -9:]
    deviation = np.sqrt(np.diag(covariance))
    assert np.abs((states.mean[0, 0] - solution[-9:]) / deviation).max() < 1e-5
    apart = (states.covariance[0, 0] - covariance) / np.outer(deviation, deviation)
    assert np.abs(apart).max() < 1e-5


def test_a_constant_error_of_readings_is_not_filtered_away() -> None:
    """The stated covariance of a marker at rest ends at what the constant errors make of it."""
    rng = np.random.default_rng(2)
    jacobian = rng.standard_normal((SENSORS, 3))
    root = 0.3 * rng.standard_normal((SENSORS, SENSORS))
    bias = root @ root.T
    still = MotionModels((False,), (1e-6,), 1.0)
    states = start()
    used = np.ones(SENSORS, dtype=np.bool_)
    for _ in range(3000):
        states = mix_and_predict(still, states, np.array([0.01]))
        states, _, _ = joint_update(states, innovation(jacobian, used, bias), np.zeros((1, 1, 4)))
    # What many exposures leave: weighted least squares of readings that are wrong all alike.
    weight = np.linalg.inv(bias)
    left = np.linalg.inv(jacobian.T @ weight @ jacobian)
    assert np.allclose(states.covariance[0, 0, :3, :3], left, rtol=0.05)


def test_a_reading_that_is_certain_is_the_joint_updates() -> None:
    rng = np.random.default_rng(8)
    jacobian = rng.standard_normal((SENSORS, 3))
    bias = 0.02 * np.eye(SENSORS)
    motion = MotionModels.of(TrackerSettings())
    states = mix_and_predict(motion, start(models=2), np.array([0.05]))
    states.bias_cross_covariance[..., :3, :] = 0.01 * rng.standard_normal((3, SENSORS))
    used = np.array([False, False, True, False])
    difference = np.zeros((1, 2, SENSORS))
    difference[..., 2] = 0.3
    hard, log, _ = joint_update(states, innovation(jacobian, used, bias), difference)
    soft = PdaMixture(np.ones((1, 1)), np.full((1, 1), 0.3), np.full((1, 1), 0.01))
    whole = combine_modes(motion, states)
    other = pda_update(states, whole, soft, 2, jacobian[None, 2], bias[None, 2])
    assert np.allclose(other.mean, hard.mean)
    assert np.allclose(other.covariance, hard.covariance, atol=1e-6)
    assert np.allclose(other.bias_cross_covariance, hard.bias_cross_covariance)
    likelihood = np.exp(log) * states.probability
    assert np.allclose(other.probability, likelihood / likelihood.sum(axis=1, keepdims=True))


def test_a_soft_reading_has_the_moments_of_its_mixture() -> None:
    """Mean and covariance of the posterior mixture, worked out one possibility after another."""
    rng = np.random.default_rng(3)
    jacobian = rng.standard_normal((1, 3))
    states = start()
    bias = np.zeros((1, SENSORS))
    weight, difference = np.array([[0.5, 0.3]]), np.array([[0.4, -1.1]])
    variance = np.array([[0.01, 0.5]])
    after = pda_update(
        states,
        combine_modes(ONE_MODEL, states),
        PdaMixture(weight, difference, variance),
        0,
        jacobian,
        bias,
    )
    parts = [(0.2, states.mean[0, 0], states.covariance[0, 0])]
    across = states.covariance[0, 0][:, :3] @ jacobian[0]
    own = jacobian[0] @ across[:3]
    for chance, off, noise in zip(weight[0], difference[0], variance[0], strict=True):
        gain = across / (own + noise)
        parts.append((chance, gain * off, states.covariance[0, 0] - np.outer(gain, across)))
    mean = sum(chance * one for chance, one, _ in parts)
    spread = sum(chance * (cov + np.outer(one - mean, one - mean)) for chance, one, cov in parts)
    assert np.allclose(after.mean[0, 0], mean)
    assert np.allclose(after.covariance[0, 0], spread)


def test_a_marker_that_was_lost_for_long_is_known_as_well_as_it_is_seen_again() -> None:
    """Rounding makes no variance negative: half a metre first, then a tenth of a millimetre."""
    rng = np.random.default_rng(3)
    states = mix_and_predict(ONE_MODEL, start(), np.array([1.0]))
    used = np.ones(SENSORS, dtype=np.bool_)
    for nearly_alike in (1.0, 0.1):
        for _ in range(10):
            jacobian = 2.0 * (rng.standard_normal(3) + nearly_alike * rng.standard_normal((4, 3)))
            after, _, _ = joint_update(states, innovation(jacobian, used), np.zeros((1, 1, 4)))
            known = np.linalg.inv(100.0 * jacobian.T @ jacobian)
            # What was known before adds next to nothing to what the readings say.
            np.testing.assert_allclose(
                after.covariance[0, 0, :3, :3], known, rtol=1e-3, atol=1e-4 * known.max()
            )
            sd = np.sqrt(np.diag(after.covariance[0, 0]))
            alike = after.covariance[0, 0] / np.outer(sd, sd)
            assert np.linalg.eigvalsh(alike)[0] > -1e-9
