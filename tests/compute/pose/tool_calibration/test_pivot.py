"""Pivot calibration: honest covariance, wrong poses named, and reasons where there is no tip."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from compute.errors import (
    HighError,
    InvalidParameter,
    NonFiniteValue,
    TooFewPoses,
    TooLittleRotation,
)
from compute.pose.tool_calibration.pivot import PivotSettings, pivot_calibration
from compute.transform import Transform, rotation_matrix
from tests.compute.pose.motions import (
    Array,
    check_mean,
    disturbed,
    pose_covariance,
    transforms,
    vectors,
)

TIP = np.array([5.0, -3.0, 150.0])
PIVOT = np.array([10.0, 20.0, 1500.0])


def pivoted(
    chance: np.random.Generator, poses: int = 40, half_deg: float = 30.0, tip: Array = TIP
) -> tuple[Array, Array]:
    """Return poses of a tool that leans up to ``half_deg`` to any side, and spins by a radian."""
    lean = chance.normal(size=(poses, 3)) * [1.0, 1.0, 0.0]
    lean *= np.radians(chance.uniform(0.0, half_deg, (poses, 1))) / np.linalg.norm(
        lean, axis=1, keepdims=True
    )
    spin = np.outer(chance.uniform(-1.0, 1.0, poses), [0.0, 0.0, 1.0])
    rotations = rotation_matrix(lean) @ rotation_matrix(spin)
    return rotations, PIVOT - rotations @ tip


@settings(max_examples=30)
@given(st.integers(0, 1000), vectors(300.0), transforms(covariance=False))
def test_without_noise_it_is_exact_anywhere(seed: int, tip: Array, anywhere: Transform) -> None:
    rotations, translations = pivoted(np.random.default_rng(seed), tip=tip)
    rotations = anywhere.rotation @ rotations
    translations = anywhere.apply(translations)
    found = pivot_calibration(rotations, translations)
    assert np.allclose(found.tip_mm, tip, atol=1e-6)
    assert np.allclose(found.pivot_mm, anywhere.apply(PIVOT), atol=1e-6)
    assert found.rms_mm < 1e-6


def test_the_covariance_is_what_the_tip_errs_by_and_wrong_poses_are_named() -> None:
    squares, pivots, wrong = [], [], 0
    for seed in range(40):
        chance = np.random.default_rng(seed)
        rotations, translations = pivoted(chance)
        covariances = np.array([pose_covariance(chance) for _ in rotations])
        seen = disturbed(chance, rotations, translations, covariances)
        out = np.sort(chance.choice(40, 4, replace=False))
        seen[1][out] += chance.choice([-1.0, 1.0], (4, 3)) * chance.uniform(3.0, 40.0, (4, 3))
        found = pivot_calibration(*seen, covariances)
        error = found.tip_mm - TIP
        squares.append(error @ np.linalg.solve(found.tip_covariance_mm2, error))
        error = found.pivot_mm - PIVOT
        pivots.append(error @ np.linalg.solve(found.pivot_covariance_mm2, error))
        wrong += found.outlying != tuple(out)
    # Where poses happen to scatter more than they say, the covariance is enlarged: by 4 %, on
    # average, at this number of poses.
    check_mean(squares, 3, 0.06)
    check_mean(pivots, 3, 0.06)
    # One good pose in 10 000 is left out by chance.
    assert wrong <= 3


def test_where_poses_have_no_covariance_their_scatter_tells() -> None:
    squares = []
    for seed in range(40):
        chance = np.random.default_rng(seed)
        rotations, translations = pivoted(chance)
        noisy = translations + 0.2 * chance.normal(size=translations.shape)
        found = pivot_calibration(rotations, noisy)
        assert found.residual_sigma is None
        error = found.tip_mm - TIP
        squares.append(error @ np.linalg.solve(found.tip_covariance_mm2, error))
    check_mean(squares, 3, 0.06)


def test_weights_are_worth_having() -> None:
    """Half of the poses have ten times the noise: the weighted tip errs far less."""
    errors = []
    for seed in range(20):
        chance = np.random.default_rng(seed)
        rotations, translations = pivoted(chance)
        size = np.where(np.arange(40) % 2, 10.0, 1.0)
        covariances = np.eye(6) * ([1e-8] * 3 + [0.01] * 3) * size[:, None, None] ** 2
        seen = disturbed(chance, rotations, translations, covariances)
        settings = PivotSettings(max_rms_mm=10.0)
        errors.append(
            [
                np.linalg.norm(pivot_calibration(*seen, given, settings).tip_mm - TIP)
                for given in (covariances, covariances[:1].repeat(40, axis=0) * 25.0)
            ]
        )
    weighted, even = np.sqrt((np.array(errors) ** 2).mean(axis=0))
    assert weighted < 0.5 * even


def test_poses_of_more_scatter_than_they_say_enlarge_the_covariance() -> None:
    chance = np.random.default_rng(5)
    rotations, translations = pivoted(chance, 200)
    covariances = np.broadcast_to(np.eye(6) * ([1e-10] * 3 + [0.01] * 3), (200, 6, 6))
    seen = disturbed(chance, rotations, translations, covariances)
    honest = pivot_calibration(*seen, covariances)
    boasting = pivot_calibration(*seen, covariances / 9.0)
    assert boasting.residual_sigma == pytest.approx(3.0, rel=0.15)
    assert np.allclose(boasting.tip_covariance_mm2, honest.tip_covariance_mm2, rtol=0.3, atol=1e-6)


def test_too_few_poses() -> None:
    rotations, translations = pivoted(np.random.default_rng(0), 9)
    with pytest.raises(TooFewPoses, match=r"9 poses; .* at least 10"):
        pivot_calibration(rotations, translations)


def test_turned_about_one_axis_only_the_tip_is_undetermined_along_it() -> None:
    axis = np.array([0.6, 0.0, 0.8])
    rotations = rotation_matrix(np.outer(np.linspace(-1.0, 1.0, 40), axis))
    with pytest.raises(TooLittleRotation) as caught:
        pivot_calibration(rotations, PIVOT - rotations @ TIP)
    context = caught.value.context
    assert np.allclose(np.abs(np.array(context["undetermined"])), np.abs(axis), atol=1e-6)
    assert context["swing_deg"][0] == pytest.approx(0.0, abs=1e-4)  # type: ignore[index]
    assert context["range_deg"] == pytest.approx(np.degrees(2.0))
    assert "5.0 deg" in caught.value.detail


def test_turned_too_little_says_how_far() -> None:
    rotations, translations = pivoted(np.random.default_rng(0), half_deg=4.0)
    with pytest.raises(TooLittleRotation) as caught:
        pivot_calibration(rotations, translations)
    # It spins by a radian: only the long axis hardly swung.
    swings = np.array(caught.value.context["swing_deg"])
    assert swings[0] < 5.0 < 20.0 < swings[1]
    assert abs(np.array(caught.value.context["undetermined"])[2]) > 0.99
    with pytest.raises(TooLittleRotation, match=r"span 0\.0 deg"):
        pivot_calibration(np.broadcast_to(np.eye(3), (20, 3, 3)), np.zeros((20, 3)))


def test_a_tip_that_slips_is_refused_with_its_error() -> None:
    chance = np.random.default_rng(0)
    rotations, translations = pivoted(chance)
    translations += 3.0 * chance.normal(size=translations.shape)
    with pytest.raises(HighError, match=r"mm RMS off .* within 1 mm") as caught:
        pivot_calibration(rotations, translations)
    assert caught.value.context["rms_mm"] == pytest.approx(3.0 * np.sqrt(3.0), rel=0.3)


def test_when_most_poses_disagree_there_is_no_tip() -> None:
    chance = np.random.default_rng(0)
    rotations, translations = pivoted(chance)
    translations += 0.05 * chance.normal(size=translations.shape)
    translations[:17] += chance.uniform(50.0, 300.0, (17, 3))
    with pytest.raises(HighError, match="17 of 40 poses do not fit"):
        pivot_calibration(rotations, translations)


def test_what_is_no_pose_is_refused_with_its_number() -> None:
    rotations, translations = pivoted(np.random.default_rng(0))
    covariances = np.broadcast_to(np.eye(6), (40, 6, 6)).copy()
    translations[7, 1] = np.nan
    with pytest.raises(NonFiniteValue, match="pose 7"):
        pivot_calibration(rotations, translations)
    translations[7, 1] = 0.0
    rotations[3] = np.diag([1.0, 1.0, -1.0])
    with pytest.raises(InvalidParameter, match="pose 3 is no rotation"):
        pivot_calibration(rotations, translations)
    rotations[3] = np.eye(3)
    covariances[5] = np.diag([1.0, 1.0, 1.0, 1.0, 1.0, 0.0])
    with pytest.raises(InvalidParameter, match="pose 5 is not positive"):
        pivot_calibration(rotations, translations, covariances)
    with pytest.raises(InvalidParameter, match=r"rotations has shape \(39, 3, 3\)"):
        pivot_calibration(rotations[1:], translations)
