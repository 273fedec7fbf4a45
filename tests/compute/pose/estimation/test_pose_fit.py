"""Poses come from readings alone, are as uncertain as they say, and are withheld with a reason."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from compute.camera.stack import CameraStack
from compute.errors import InvalidParameter
from compute.mapping.grid import VoxelGrid
from compute.mapping.table import CorrectionTable
from compute.measurement.measurement_model import MeasurementModel
from compute.pose.estimation.pose_fit import fit_pose
from compute.pose.estimation.pose_initialisation import initial_pose_from_points
from compute.pose.rigid_body import PoseStatus
from compute.pose.settings import PoseFitSettings
from compute.transform import Transform
from tests.compute.distorted_rig import distorted_rig
from tests.compute.pose.scene import (
    CALIBRATION,
    CAMERAS,
    MARKERS_MM,
    MIDDLE_MM,
    SIGMA_PX,
    Body,
    body,
    pointer,
    pose_square,
    random_rotation,
)
from tests.compute.rig import rig

SIGMA = np.full(4, SIGMA_PX)


def somewhere(rng: np.random.Generator) -> Body:
    return Body(pointer(), random_rotation(rng), MIDDLE_MM + rng.uniform(-120.0, 120.0, 3))


def two_of_four(rng: np.random.Generator) -> np.ndarray:
    mask = np.zeros((4, 4), dtype=bool)
    for marker in range(4):
        mask[marker, rng.choice(4, 2, replace=False)] = True
    return mask


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=25, deadline=None)
def test_exact_readings_give_the_pose_from_no_start(seed: int) -> None:
    rng = np.random.default_rng(seed)
    true = somewhere(rng)
    found = fit_pose(CAMERAS, true.tool, CAMERAS.project(true.markers_mm), SIGMA)
    assert found.status is PoseStatus.OK
    assert found.rotation == pytest.approx(true.rotation, abs=1e-8)
    assert found.translation_mm == pytest.approx(true.translation_mm, abs=1e-6)
    assert found.tip_mm == pytest.approx(true.tip_world_mm, abs=1e-6)
    assert found.markers_used == 4
    assert found.readings_used == 16


def test_two_sensors_a_marker_are_enough_and_the_covariance_is_right() -> None:
    rng = np.random.default_rng(1)
    squares, tips = [], []
    for _ in range(120):
        true = somewhere(rng)
        exact = np.where(two_of_four(rng), CAMERAS.project(true.markers_mm), np.nan)
        readings = exact + SIGMA_PX * rng.standard_normal((4, 4))
        found = fit_pose(
            CAMERAS,
            true.tool,
            readings,
            SIGMA,
            settings=PoseFitSettings(max_detectable_sigma=None),
        )
        assert found.status is PoseStatus.OK, found.reason
        squares.append(pose_square(found.rotation, found.translation_mm, found.covariance, true))
        off = true.tip_world_mm - found.tip_mm
        tips.append(off @ np.linalg.solve(found.tip_covariance_mm2, off))
    # Mean of 120 chi-squares of 6 and 3: deviations 0.32 and 0.22.
    assert np.mean(squares) == pytest.approx(6.0, abs=1.2)
    assert np.mean(tips) == pytest.approx(3.0, abs=0.9)


@pytest.mark.slow
def test_the_calibrations_covariance_is_common_to_all_markers() -> None:
    rng = np.random.default_rng(2)
    model = MeasurementModel.of(CAMERAS, CALIBRATION)
    root = np.sqrt(np.diag(CALIBRATION))
    squares, as_noise = [], []
    for _ in range(120):
        true = somewhere(rng)
        cameras = CAMERAS.retract((root * rng.standard_normal(28)).reshape(4, 7))
        readings = cameras.project(true.markers_mm) + SIGMA_PX * rng.standard_normal((4, 4))
        found = fit_pose(model, true.tool, readings, SIGMA)
        assert found.status is PoseStatus.OK, found.reason
        squares.append(pose_square(found.rotation, found.translation_mm, found.covariance, true))
        # What it would be if each reading had an error of this size of its own.
        jacobian = CAMERAS.parameter_jacobian(true.markers_mm)
        each = np.sqrt(SIGMA_PX**2 + ((jacobian * root.reshape(4, 7)) ** 2).sum(axis=2))
        other = fit_pose(CAMERAS, true.tool, readings, each)
        if other.rotation is not None:
            square = pose_square(other.rotation, other.translation_mm, other.covariance, true)
            as_noise.append(square)
    assert np.mean(squares) == pytest.approx(6.0, abs=1.2)
    assert abs(np.mean(as_noise) - 6.0) > 1.2


def test_it_is_the_least_squares_solution() -> None:
    rng = np.random.default_rng(3)
    true = somewhere(rng)
    readings = CAMERAS.project(true.markers_mm) + SIGMA_PX * rng.standard_normal((4, 4))
    readings[0, 1] = np.nan

    def residual(x: np.ndarray) -> np.ndarray:
        rotation = Rotation.from_rotvec(x[:3]).as_matrix()
        off = readings - CAMERAS.project(MARKERS_MM @ rotation.T + x[3:])
        return off[np.isfinite(readings)] / SIGMA_PX

    start = np.r_[Rotation.from_matrix(true.rotation).as_rotvec(), true.translation_mm]
    peer = least_squares(residual, start, xtol=1e-15, ftol=1e-15, gtol=1e-15, x_scale="jac")
    found = fit_pose(CAMERAS, true.tool, readings, SIGMA)
    assert found.chi2 == pytest.approx(2.0 * peer.cost, rel=1e-6)
    assert found.translation_mm == pytest.approx(peer.x[3:], abs=1e-4)


@pytest.mark.parametrize("start", ["points", "near", "wrong"])
def test_starts_lead_to_the_same_pose(start: str) -> None:
    rng = np.random.default_rng(4)
    true = somewhere(rng)
    readings = CAMERAS.project(true.markers_mm) + SIGMA_PX * rng.standard_normal((4, 4))
    whole = fit_pose(CAMERAS, true.tool, readings, SIGMA)
    if start == "points":
        points = true.markers_mm.copy()
        points[2] = np.nan
        found = fit_pose(CAMERAS, true.tool, readings, SIGMA, points_mm=points)
    else:
        turn = 0.1 if start == "near" else 3.0
        rotation = Rotation.from_rotvec([0.0, turn, 0.0]).as_matrix() @ true.rotation
        given = Transform(rotation, true.translation_mm + 20.0)
        found = fit_pose(CAMERAS, true.tool, readings, SIGMA, start=given)
    assert found.translation_mm == pytest.approx(whole.translation_mm, abs=1e-5)


def test_distortion_and_a_correction_table_are_in_the_model() -> None:
    rng = np.random.default_rng(5)
    models = distorted_rig(((3, 0), (1, 2)))
    cameras = CameraStack.of(models)
    grid = VoxelGrid((-300.0, -300.0, 1200.0), (100.0, 100.0, 100.0), (6, 6, 6))
    table = CorrectionTable(
        tuple(model.name for model in models),
        "",
        grid,
        3,
        rng.uniform(-3.0, 3.0, (4, 9, 9, 9)),
        np.full((4, 7, 7, 7), SIGMA_PX**2),
        np.ones((4, 6, 6, 6), dtype=bool),
    )
    true = somewhere(rng)
    places = true.markers_mm
    readings = cameras.project(places) - table.at(places).value_px
    found = fit_pose(cameras, true.tool, readings, SIGMA, corrections=table)
    assert found.status is PoseStatus.OK
    assert found.translation_mm == pytest.approx(true.translation_mm, abs=1e-6)
    without = fit_pose(CameraStack.of(rig()), true.tool, readings, SIGMA)
    assert without.status is not PoseStatus.OK
    sure = replace(table, variance_px2=np.zeros((4, 7, 7, 7)))
    surer = fit_pose(cameras, true.tool, readings, SIGMA, corrections=sure)
    assert 2.0 * surer.tip_covariance_mm2 == pytest.approx(found.tip_covariance_mm2, rel=1e-3)


def test_the_cubic_term_is_in_the_model() -> None:
    rng = np.random.default_rng(6)
    cameras = CameraStack.of([replace(one, cubic_per_px2=2e-9) for one in rig()])
    true = somewhere(rng)
    model = MeasurementModel.of(cameras)
    readings, slope = model.linearise(true.markers_mm)
    assert cameras.add_cubic_term(readings) == pytest.approx(
        cameras.project(true.markers_mm), abs=1e-9
    )
    step = np.array([0.01, -0.02, 0.03])
    moved, _ = model.linearise(true.markers_mm + step)
    assert moved - readings == pytest.approx(slope @ step, abs=1e-5)
    found = fit_pose(cameras, true.tool, readings, SIGMA)
    assert found.translation_mm == pytest.approx(true.translation_mm, abs=1e-6)


def test_one_wrong_reading_is_left_out_and_named() -> None:
    rng = np.random.default_rng(7)
    true = somewhere(rng)
    exact = CAMERAS.project(true.markers_mm) + SIGMA_PX * rng.standard_normal((4, 4))
    whole = fit_pose(CAMERAS, true.tool, exact, SIGMA)
    readings = exact.copy()
    readings[2, 1] += 40.0
    found = fit_pose(CAMERAS, true.tool, readings, SIGMA)
    assert found.status is PoseStatus.OK
    assert found.excluded == ((2, 1),)
    assert found.reason == "the reading of marker 3 by sensor 2 was excluded as wrong"
    assert found.readings_used == 15
    square = pose_square(whole.rotation, whole.translation_mm, found.covariance, true)
    assert square < 30.0
    readings[0, 3] -= 30.0
    both = fit_pose(CAMERAS, true.tool, readings, SIGMA)
    assert both.status is PoseStatus.INVALID
    assert both.rotation is None
    assert "do not fit the tool" in str(both.reason)


@pytest.mark.slow
def test_with_hardly_any_redundancy_no_reading_is_blamed() -> None:
    rng = np.random.default_rng(8)
    statuses = []
    for _ in range(60):
        true = somewhere(rng)
        readings = np.where(two_of_four(rng), CAMERAS.project(true.markers_mm), np.nan)
        marker, sensor = np.argwhere(np.isfinite(readings))[rng.integers(8)]
        readings[marker, sensor] += 30.0
        found = fit_pose(CAMERAS, true.tool, readings, SIGMA)
        assert found.excluded == ()
        statuses.append(found.status)
    # 600 standard deviations: hidden only where nothing checks the reading, and then it is said.
    assert PoseStatus.OK not in statuses
    assert statuses.count(PoseStatus.INVALID) > 50


@pytest.mark.parametrize(
    ("mask", "words"),
    [
        ([[1, 1, 1, 0], [1, 1, 1, 0], [0] * 4, [0] * 4], "6 readings of 2 markers; a pose takes 6"),
        ([[1, 1, 1, 1], [1, 1, 1, 1], [0] * 4, [0] * 4], "only markers 1 and 2 were seen"),
        ([[0] * 4] * 4, "no readings of no markers"),
    ],
)
def test_what_is_not_observable_has_no_pose_but_a_reason(mask: list, words: str) -> None:
    true = body(pointer(), 9)
    readings = np.where(np.array(mask, dtype=bool), CAMERAS.project(true.markers_mm), np.nan)
    found = fit_pose(CAMERAS, true.tool, readings, SIGMA)
    assert found.status is PoseStatus.MISSING
    assert found.rotation is None
    assert words in str(found.reason)


def test_two_sensors_leave_a_shift_open_and_it_is_named() -> None:
    true = body(pointer(), 9)
    readings = CAMERAS.project(true.markers_mm)
    readings[:, 2:] = np.nan
    start = Transform(true.rotation, true.translation_mm)
    # Perspective alone tells it, to 30 times the others: enough at 0.05 px, not at 1 px.
    assert fit_pose(CAMERAS, true.tool, readings, SIGMA, start=start).status is PoseStatus.OK
    found = fit_pose(CAMERAS, true.tool, readings, np.ones(4), start=start)
    assert found.status is PoseStatus.MISSING
    assert "a shift along" in str(found.reason)
    assert "marker 1 by sensors 1 and 2" in str(found.reason)


def test_two_solutions_that_fit_equally_well_are_no_pose() -> None:
    true = body(pointer(), 9)
    readings = CAMERAS.project(true.markers_mm)
    readings[[0, 1, 3], 1:] = np.nan
    found = fit_pose(CAMERAS, true.tool, readings, SIGMA)
    assert found.status is PoseStatus.INVALID
    assert "fit the tool in 2 ways" in str(found.reason)
    assert found.rotation is None
    start = Transform(true.rotation, true.translation_mm)
    told = fit_pose(CAMERAS, true.tool, readings, SIGMA, start=start)
    assert told.translation_mm == pytest.approx(true.translation_mm, abs=1e-5)


@given(st.integers(0, 2**32 - 1), st.integers(3, 8))
@settings(max_examples=40, deadline=None)
def test_points_lay_a_tool_and_never_mirror_it(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    markers = rng.uniform(-100.0, 100.0, (count, 3))
    rotation, shift = random_rotation(rng), rng.uniform(-1e3, 1e3, 3)
    found = initial_pose_from_points(markers, markers @ rotation.T + shift)
    assert found is not None
    assert found[0] == pytest.approx(rotation, abs=1e-6)
    assert found[1] == pytest.approx(shift, abs=1e-3)
    mirrored = initial_pose_from_points(markers, (markers * [1.0, 1.0, -1.0]) @ rotation.T + shift)
    assert mirrored is not None
    assert np.linalg.det(mirrored[0]) == pytest.approx(1.0)


def test_points_on_a_line_are_no_start() -> None:
    line = np.outer(np.arange(4.0), [10.0, 5.0, 1.0])
    assert initial_pose_from_points(line, line) is None
    assert initial_pose_from_points(MARKERS_MM[:2], MARKERS_MM[:2]) is None


def test_shapes_are_checked() -> None:
    with pytest.raises(InvalidParameter, match="have the shape"):
        fit_pose(CAMERAS, pointer(), np.zeros((3, 4)), SIGMA)
    with pytest.raises(InvalidParameter, match="sigma_px has the shape"):
        fit_pose(CAMERAS, pointer(), np.zeros((4, 4)), np.ones(3))


@pytest.mark.slow
def test_reliability_says_from_where_on_an_error_is_found_and_what_a_smaller_one_does() -> None:
    """By errors of that size, whatever the formulae are."""
    true = body(pointer(), 9)
    exact = CAMERAS.project(true.markers_mm)
    exact[0, 1] = exact[1, 2] = exact[3, 0] = np.nan
    stated = fit_pose(CAMERAS, true.tool, exact, SIGMA).reliability
    assert stated is not None
    size = SIGMA_PX * stated.detectable_sigma
    rng = np.random.default_rng(4)
    start = Transform(true.rotation, true.translation_mm)
    found = 0
    for _ in range(200):
        readings = exact + SIGMA_PX * rng.standard_normal(exact.shape)
        readings[stated.marker, stated.sensor] += size
        settings = PoseFitSettings(max_excluded=0, max_detectable_sigma=None)
        fit = fit_pose(CAMERAS, true.tool, readings, SIGMA, start=start, settings=settings)
        found += fit.status is PoseStatus.INVALID
    assert found / 200 == pytest.approx(0.8, abs=0.09)
    shifts = []
    for marker, sensor in np.argwhere(np.isfinite(exact)):
        moved = exact.copy()
        moved[marker, sensor] += 0.01 * SIGMA_PX
        shifts.append(fit_pose(CAMERAS, true.tool, moved, SIGMA, start=start).tip_mm)
    tip = fit_pose(CAMERAS, true.tool, exact, SIGMA, start=start).tip_mm
    by_sigma = 100.0 * np.linalg.norm(np.array(shifts) - tip, axis=1)
    assert stated.external_tip_mm <= 1.02 * stated.detectable_sigma * by_sigma.max()
    assert stated.external_tip_mm > by_sigma.max() * 5.0


def test_a_mirrored_body_of_four_markers_is_no_good_pose_at_low_redundancy() -> None:
    rng = np.random.default_rng(21)
    statuses = []
    for _ in range(40):
        true = somewhere(rng)
        mirrored = true.tool.markers_mm * np.array([-1.0, 1.0, 1.0])
        places = mirrored @ true.rotation.T + true.translation_mm
        mask = two_of_four(rng)
        mask[0] = True
        readings = np.where(mask, CAMERAS.project(places), np.nan)
        readings += SIGMA_PX * rng.standard_normal(readings.shape)
        statuses.append(fit_pose(CAMERAS, true.tool, readings, SIGMA).status)
    assert PoseStatus.OK not in statuses


def test_a_pose_that_little_checks_is_low_reliability_and_a_setting_allows_it() -> None:
    rng = np.random.default_rng(2)
    true = somewhere(rng)
    readings = np.where(two_of_four(rng), CAMERAS.project(true.markers_mm), np.nan)
    found = fit_pose(CAMERAS, true.tool, readings, SIGMA)
    assert found.status is PoseStatus.LOW_RELIABILITY
    assert found.rotation is not None
    assert "standard deviations" in str(found.reason)
    allowed = PoseFitSettings(max_detectable_sigma=None)
    assert fit_pose(CAMERAS, true.tool, readings, SIGMA, settings=allowed).status is PoseStatus.OK
