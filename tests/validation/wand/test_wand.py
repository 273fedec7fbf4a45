"""The case wand: 200 poses of a bar against a frame of known points, on seeds of their own."""

import numpy as np
import pytest

import validation.wand.case as wand
from validation.all_cases import ALL_CASES
from validation.wand.scene import aligned_errors, points, wand_markers

pytestmark = pytest.mark.slow


def test_200_poses_are_as_good_as_a_frame() -> None:
    """The issue's bound, over three repeats: at most 1.5 times the frame's error."""
    seeds = range(1000, 1003)
    bar = np.mean([wand.wand_errors(200, seed).total ** 2 for seed in seeds])
    for count in wand.FRAMES:
        frame = np.mean([wand.frame_errors(count, seed).total ** 2 for seed in seeds])
        assert np.sqrt(bar / frame) < 1.5


def test_more_poses_are_better() -> None:
    errors = [
        np.sqrt(np.mean([wand.wand_errors(poses, seed).calibration ** 2 for seed in range(3)]))
        for poses in (25, 100)
    ]
    assert errors[1] < errors[0]


def test_a_start_of_20_percent_reaches_the_solution() -> None:
    assert wand.reaches(0.2, 1000)


def test_scene_is_what_the_case_says() -> None:
    rng = np.random.default_rng(1)
    markers = wand_markers(rng, 50)
    assert np.allclose(np.linalg.norm(markers[:, 0] - markers[:, 1], axis=1), 300.0)
    assert np.abs(markers - [0.0, 0.0, 1500.0]).max() <= 200.0
    cloud = points(rng, 30)
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    assert np.abs(aligned_errors(cloud @ turn.T + 5.0, cloud)).max() < 1e-9
    mirrored = cloud * [-1.0, 1.0, 1.0]
    assert np.abs(aligned_errors(mirrored, cloud)).max() > 10.0


def test_case_is_registered() -> None:
    assert ALL_CASES["wand"] is wand.CASE
