"""Frames averaged: honest deviations, movement refused and rest not."""

import numpy as np
import pytest

from service.api.captures.averaging import average
from service.problems.errors import NoObservation, TargetMoved

NAMES = ("left", "middle", "right", "vertical")
FRAMES = 50
SIGMA_PX = 0.1


def still(generator: np.random.Generator, frames: int = FRAMES) -> np.ndarray:
    return 1000.0 + generator.normal(0.0, SIGMA_PX, (frames, 4))


def stated(frames: int = FRAMES) -> np.ndarray:
    return np.full((frames, 4), SIGMA_PX)


def test_means_and_their_deviations_are_honest():
    generator = np.random.default_rng(2)
    squares = []
    for _ in range(400):
        found = average(still(generator), stated(), NAMES, 0.8, "P1")
        squares.append(((found.mean_px - 1000.0) / found.sigma_px) ** 2)
        assert (found.frames == FRAMES).all()
    # Deviations are of the larger of two estimates: a little too wide, never too narrow.
    assert 0.8 < np.mean(squares) < 1.08


@pytest.mark.slow
def test_rest_is_not_taken_for_movement():
    generator = np.random.default_rng(3)
    for _ in range(1500):
        average(still(generator), stated(), NAMES, 0.8, "P1")
        average(still(generator), np.full((FRAMES, 4), np.nan), NAMES, 0.8, "P1")


@pytest.mark.parametrize("known", [True, False])
def test_a_drift_is_refused_and_named(known: bool):
    generator = np.random.default_rng(4)
    readings = still(generator)
    readings[:, 2] += np.linspace(0.0, 0.6, FRAMES)
    own = stated() if known else np.full((FRAMES, 4), np.nan)
    with pytest.raises(TargetMoved, match=r'target "P7".*sensor right (spread|drift)'):
        average(readings, own, NAMES, 0.8, "P7")


def test_a_tremor_is_refused_where_the_noise_is_known():
    generator = np.random.default_rng(5)
    readings = still(generator)
    readings[:, 1] += 0.5 * np.sin(np.arange(FRAMES))
    with pytest.raises(TargetMoved, match="sensor middle spread by") as error:
        average(readings, stated(), NAMES, 0.8, "P1")
    assert error.value.context["sensor"] == "middle"


def test_a_sensor_that_sees_it_seldom_is_left_out():
    readings = still(np.random.default_rng(6))
    readings[20:, 3] = np.nan
    found = average(readings, stated(), NAMES, 0.8, "P1")
    assert np.isfinite(found.mean_px).tolist() == [True, True, True, False]
    readings[20:, 2] = np.nan
    with pytest.raises(NoObservation, match="right 20, vertical 20"):
        average(readings, stated(), NAMES, 0.8, "P1")
