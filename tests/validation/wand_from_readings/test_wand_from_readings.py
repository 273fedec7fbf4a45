"""The case wand-from-readings: its scene, and rigs on seeds of their own."""

import numpy as np
import pytest

import validation.wand_from_readings.case as case
from compute.calibration.self_calibration.self_calibrate import self_calibrate
from compute.calibration.self_calibration.targets import Recording, Wand
from compute.camera.stack import CameraStack
from validation.all_cases import ALL_CASES
from validation.wand_from_readings.scene import Directions, random_bar


def test_scene_agrees_with_the_camera_model() -> None:
    """Two projections that share no code."""
    rng = np.random.default_rng(1)
    for distorted in (False, True):
        bar = random_bar(rng, 5, distorted=distorted)
        points = bar.centre_mm + rng.uniform(-0.3, 0.3, (50, 3)) * bar.side_mm
        projected = CameraStack.of(case.true_models(bar)).project(points)
        exact = bar.read(points)
        seen = np.isfinite(exact)
        assert seen.mean() > 0.9
        assert projected[seen] == pytest.approx(exact[seen], abs=1e-6)


def test_draw_depends_on_seed_and_trial() -> None:
    row = case.ROWS[0]
    first = case.draw_wave(row, 1, 0).readings_px
    assert np.array_equal(first, case.draw_wave(row, 1, 0).readings_px, equal_nan=True)
    assert first.shape != case.draw_wave(row, 2, 0).readings_px.shape or not np.array_equal(
        first, case.draw_wave(row, 2, 0).readings_px, equal_nan=True
    )


def test_marker_error_notices_a_mirror() -> None:
    wave = case.draw_wave(case.ROWS[2], 3, 0)
    models = case.true_models(wave.bar)
    error, mirrored = case.marker_error(models, wave)
    assert error < 1e-6
    assert not mirrored


@pytest.mark.slow
def test_adjustment_ends_at_a_minimum_where_steps_round_to_no_decrease() -> None:
    wave = case.draw_wave(case.ROWS[0], 90002, 70)
    sigma = np.full(wave.readings_px.shape, wave.sigma_px)
    recording = Recording(Wand((0.0, wave.bar.wand_mm)), wave.readings_px, sigma)
    found = self_calibrate(case.true_models(wave.bar), [recording])
    assert found.chi2_per_dof == pytest.approx(1.139, abs=0.01)
    assert case.inner_difference(found, found) == 0.0


@pytest.mark.slow
@pytest.mark.parametrize("row", case.ROWS[:3], ids=lambda row: row.label)
def test_rigs_reach_the_cameras_of_a_start_from_the_truth(row: case.Row) -> None:
    outcomes = [case.judge(case.draw_wave(row, 1000, trial)) for trial in range(2)]
    assert {one.verdict for one in outcomes} <= {"same", "lower", "near"}
    assert not any(one.mirrored for one in outcomes)


@pytest.mark.slow
def test_degenerate_waves_are_refused_by_name() -> None:
    for _, trials, refused, named in case.degenerate_waves(5, 1).rows:
        assert trials == refused == named == 1


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "trial"), [("all in one plane", 20), ("flat cloud", 19)])
def test_degenerate_wave_is_refused_where_the_first_cameras_hide_it(
    kind: Directions, trial: int
) -> None:
    """The first cameras turn the plane into a volume; or all poses come to be ambiguous."""
    outcome = case.judge(case.draw_degenerate_wave(kind, 93001, trial))
    assert outcome.verdict == "refused"
    assert case.DEGENERATE[kind] in outcome.reason


@pytest.mark.slow
@pytest.mark.parametrize("trial", [64, 124])
def test_search_that_leaves_the_true_cameras_is_not_the_last_word(trial: int) -> None:
    row = next(one for one in case.ROWS if one.always)
    outcome = case.judge(case.draw_wave(row, 93001, trial))
    assert outcome.verdict == "same", outcome


def test_case_is_registered() -> None:
    assert ALL_CASES["wand-from-readings"] is case.CASE
