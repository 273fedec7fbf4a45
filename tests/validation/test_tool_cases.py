"""The cases of tools: partial views are at their bound, and what is not told is not reported."""

import numpy as np
import pytest

from compute.measurement.measurement_model import MeasurementModel
from validation.all_cases import ALL_CASES
from validation.partial_view.case import MAX_RATIO, UNOBSERVABLE, bound, pairings, simulate_views
from validation.partial_view.scene import CENTRE_MM, MARKERS_MM, SIGMA_PX, rig
from validation.pointer_tip.case import Tips
from validation.pointer_tip.scene import MARKERS_MM as POINTER_MM
from validation.pointer_tip.scene import TIP_MM as POINTER_TIP_MM
from validation.pointer_tip.scene import random_strokes
from validation.strobed_tools.case import Scores, compare
from validation.strobed_tools.scene import COURSES, FAST, REST, draw_run, since_change_s


def test_the_cases_are_there() -> None:
    assert {"partial-view", "pointer-tip", "strobed-tools"} <= set(ALL_CASES)


@pytest.mark.slow
@pytest.mark.parametrize("calibrated", [False, True])
def test_partial_views_are_at_the_bound(calibrated: bool) -> None:
    seen = simulate_views(pairings(), calibrated=calibrated, trials=150, seed=5)
    assert seen.points == 0
    assert seen.statuses["OK"] >= 140
    assert seen.ratio(slice(0, 3)) < MAX_RATIO
    assert seen.ratio(slice(3, 6)) < MAX_RATIO
    # Means of 150 chi-squares of 6 and 3: three deviations.
    pose, tip = seen.nees.mean(axis=0)
    assert pose == pytest.approx(6.0, abs=0.9)
    assert tip == pytest.approx(3.0, abs=0.65)


@pytest.mark.parametrize("view", UNOBSERVABLE, ids=lambda view: view[0])
def test_what_is_not_told_is_not_reported(view) -> None:
    _, masks, sigma = view
    seen = simulate_views(masks, trials=12, sigma_px=sigma)
    assert seen.statuses["OK"] == 0
    assert len(seen.error) == 0
    assert all(reason != "None" for reason in seen.reasons.values())


def test_the_bound_is_that_of_the_slopes() -> None:
    cameras = rig()
    rotation = np.eye(3)
    whole = bound(
        MeasurementModel(cameras), rotation, CENTRE_MM, np.ones((4, 4), dtype=np.bool_), SIGMA_PX
    )
    step = 1e-3
    readings = cameras.project(MARKERS_MM + CENTRE_MM)
    moved = cameras.project(MARKERS_MM + CENTRE_MM + np.array([0.0, step, 0.0]))
    slope = (moved - readings).ravel() / step
    # Information of a shift along Y alone: the Schur complement takes the rest away.
    assert np.linalg.inv(whole)[4, 4] == pytest.approx(slope @ slope / SIGMA_PX**2, rel=1e-4)


def test_strokes_move_the_tip_as_they_say() -> None:
    (stroke,) = random_strokes(1, np.random.default_rng(0))
    for exposure in (0, 40):
        distance = np.linalg.norm(stroke.markers_mm(exposure) - stroke.tip_mm(exposure), axis=1)
        assert distance == pytest.approx(np.linalg.norm(POINTER_MM - POINTER_TIP_MM, axis=1))
    moved = np.linalg.norm(stroke.tip_mm(1000) - stroke.tip_mm(0))
    assert moved == pytest.approx(np.linalg.norm(stroke.velocity_mm_s))
    assert moved <= 150.0


def test_tips_are_summed_up() -> None:
    errors = np.array([[3.0, 0, 0], [0, 4.0, 0]])
    tips = Tips(3, errors, np.broadcast_to(np.eye(3), (2, 3, 3)))
    assert tips.rms_mm == pytest.approx(np.sqrt(12.5))
    assert tips.stated_mm == pytest.approx(np.sqrt(3.0))
    assert tips.nees == pytest.approx(12.5)
    assert tips.max_mm == pytest.approx(3.95)


@pytest.mark.slow
@pytest.mark.parametrize("course", [REST, FAST])
def test_strobed_tools_are_known_at_200_exposures_a_second(course: str) -> None:
    cell = compare(course, 200.0, 4, runs=2, seconds=0.9)
    single, imm = cell.single, cell.imm
    assert single.ok.mean() < 0.1
    assert imm.ok.mean() > 0.7
    assert imm.tip_mm < 0.7 * single.tip_mm
    # Two draws of a calibration, 200 poses that are alike: chi-square of 12 at one in a million.
    assert imm.mean_square < 24.0


def test_courses_are_what_they_are_called() -> None:
    rng = np.random.default_rng(1)
    run = draw_run(rig(), COURSES[FAST], 4, 200.0, 2.0, rng)
    centroid = run.translation_mm + run.rotation @ run.tool.markers_mm.mean(axis=0)
    speed = np.linalg.norm(np.diff(centroid, axis=0), axis=1) * 200.0
    assert speed.max() == pytest.approx(500.0, rel=0.02)
    change = np.linalg.norm(np.diff(centroid, n=2, axis=0), axis=1) * 200.0**2
    since = since_change_s(FAST, 1e-9 * run.time_ns)
    assert since is not None
    steady = since[2:] > 0.011
    assert change[steady] == pytest.approx(2000.0, rel=1e-6)
    assert since_change_s(REST, 1e-9 * run.time_ns) is None
    still = draw_run(rig(), COURSES[REST], 4, 200.0, 1.0, rng)
    assert still.bend_mm < 1e-9 < run.bend_mm


def test_scores_are_summed_up() -> None:
    nan = np.nan
    scores = Scores(
        np.array([True, False, False]),
        np.array([True, True, False]),
        np.array([6.0, 24.0, nan]),
        np.array([1.0, 9.0, nan]),
        np.array([4.0, 4.0, nan]),
        np.array([0.5, 1.5, 1.5]),
    )
    assert scores.tip_mm == pytest.approx(np.sqrt(5.0))
    assert scores.stated_mm == pytest.approx(2.0)
    assert scores.mean_square == pytest.approx(15.0)
    assert scores.overconfidence(0.0, 1.0) == pytest.approx(1.0)
    assert scores.overconfidence(1.0, 2.0) == pytest.approx(2.0)
    assert np.isnan(scores.overconfidence(2.0, 4.0))
