"""adjust: solutions, covariances, frames, outliers, errors."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from compute.calibration.bundle_adjustment.adjustment_result import AdjustmentResult
from compute.calibration.bundle_adjustment.data_snooping import normalised_residuals, redundancy
from compute.calibration.bundle_adjustment.gauge import (
    inner_constraints,
    rigid_motion_jacobian,
    transform_world,
)
from compute.calibration.bundle_adjustment.pose_set import PoseSet
from compute.calibration.bundle_adjustment.sensor_prior import SensorPrior, step_between
from compute.calibration.bundle_adjustment.solver import adjust, approximate_solution
from compute.calibration.bundle_adjustment.target_shape import (
    KnownDistance,
    body_shape,
    line_shape,
    point_shape,
)
from compute.calibration.self_calibration.pose_screening import resect
from compute.camera.stack import CameraStack
from compute.errors import InvalidParameter, NoConvergence, UndeterminedParameters
from tests.compute.calibration.bundle_adjustment.scenes import (
    BODY,
    MIDDLE,
    SIGMA_PX,
    distorted_rig,
    nudged,
    nudged_models,
    posed,
)
from tests.compute.rig import control_points, project, rig

CONTROL_MM = 0.05


def _control(seed: int, count: int = 25) -> tuple[PoseSet, np.ndarray]:
    """Control points with an uncertainty of their own, and where they really are."""
    rng = np.random.default_rng(seed)
    true = control_points(count, seed)
    read = project(rig(), true) + SIGMA_PX * rng.standard_normal((count, 4))
    given_mm = true + CONTROL_MM * rng.standard_normal(true.shape)
    covariance = np.broadcast_to(CONTROL_MM**2 * np.eye(3), (count, 3, 3))
    sigma = np.full(read.shape, SIGMA_PX)
    return PoseSet.points(given_mm, read, sigma, given_mm, covariance), true


def _bars(seed: int, poses: int = 60) -> PoseSet:
    return posed(line_shape((0.0, 200.0)), poses, np.random.default_rng(seed), rig())


def _differences(adjusted: AdjustmentResult) -> np.ndarray:
    pairs = zip(rig(), adjusted.models, strict=True)
    return np.concatenate([step_between(true, found) for true, found in pairs])


def test_exact_readings_give_back_the_sensors() -> None:
    rng = np.random.default_rng(2)
    points, true = _control(2)
    exact = replace(points, readings_px=project(rig(), true)[:, None], known_mm=true)
    found = adjust(nudged_models(rig(), rng), [exact])
    deviation = np.sqrt(np.diagonal(found.sensor_covariance))
    assert _differences(found) / deviation == pytest.approx(0.0, abs=1e-3)
    assert found.chi2 == pytest.approx(0.0, abs=1e-6)


def test_covariance_of_control_points_with_their_own_uncertainty_is_honest() -> None:
    """Over 40 runs sensors and points are off by what their covariances say."""
    sensors, places, runs, count = 0.0, 0.0, 40, 25
    for seed in range(runs):
        points, true = _control(100 + seed, count)
        found = adjust(rig(), [points])
        off = _differences(found)
        sensors += float(off @ np.linalg.solve(found.sensor_covariance, off))
        away = found.pose_sets[0].translation_mm - true
        inverse = np.linalg.inv(found.pose_covariance())
        places += float(np.einsum("bi,bij,bj->", away, inverse, away))
    # chi2 of 28 and (but for their correlation) 75 degrees of freedom in each run.
    assert sensors / runs == pytest.approx(28.0, abs=4.0 * np.sqrt(2 * 28 / runs))
    assert places / runs == pytest.approx(3.0 * count, abs=4.0 * np.sqrt(2 * 2 * 3 * count / runs))


def test_certain_control_points_make_the_covariance_of_separate_sensors() -> None:
    points, _ = _control(5)
    exact = replace(
        points,
        known_covariance_mm2=np.broadcast_to(1e-8 * np.eye(3), (len(points), 3, 3)),
        _information=None,
    )
    certain = adjust(rig(), [exact]).sensor_covariance
    uncertain = adjust(rig(), [points]).sensor_covariance
    root = np.sqrt(np.diagonal(certain))
    assert np.abs(certain / np.outer(root, root))[:7, 7:].max() < 1e-3
    root = np.sqrt(np.diagonal(uncertain))
    assert np.abs(uncertain / np.outer(root, root))[:7, 7:].max() > 0.05
    assert (np.diagonal(uncertain) > np.diagonal(certain)).all()


def test_a_free_frame_is_the_same_wherever_it_starts() -> None:
    bars = _bars(7)
    here = adjust(rig(), [bars], free_datum=True)
    turn = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix()
    shift = np.array([100.0, -50.0, 30.0])
    elsewhere = tuple(transform_world(model, turn, shift) for model in rig())
    there = adjust(elsewhere, [bars.transformed(turn, shift)], free_datum=True)
    assert there.chi2 == pytest.approx(here.chi2, rel=1e-9)
    assert there.dof == 60 * (8 - 5) - (28 - 6)
    for one, other in zip(here.models, there.models, strict=True):
        assert other.principal_distance_px == pytest.approx(one.principal_distance_px, rel=1e-6)
    spread = there.sensor_covariance[0, 0]
    assert spread == pytest.approx(here.sensor_covariance[0, 0], rel=1e-4)


def test_covariance_of_a_free_frame_leaves_the_cloud_in_its_place() -> None:
    bars = _bars(8)
    found = adjust(rig(), [bars], free_datum=True)
    cameras = CameraStack.of(found.models)
    markers = found.pose_sets[0].marker_positions().reshape(-1, 3)
    datum = inner_constraints(cameras, markers, np.full((len(markers), 4), 1.0 / SIGMA_PX))
    deviation = np.sqrt(np.diagonal(found.sensor_covariance))
    scale = np.abs(datum).T @ deviation
    spread = np.sqrt(np.abs(np.diagonal(datum.T @ found.sensor_covariance @ datum)))
    assert spread / scale == pytest.approx(0.0, abs=1e-6)


@settings(max_examples=20, deadline=None)
@given(st.lists(st.floats(-0.5, 0.5), min_size=6, max_size=6))
def test_cameras_that_move_with_the_world_read_the_same(motion: list[float]) -> None:
    turn = Rotation.from_rotvec(motion[:3]).as_matrix()
    shift = 200.0 * np.array(motion[3:])
    points = control_points(8)
    models = distorted_rig()
    moved = CameraStack.of([transform_world(model, turn, shift) for model in models])
    expected = CameraStack.of(models).project(points)
    assert moved.project(points @ turn.T + shift) == pytest.approx(expected, abs=1e-7)


def test_slopes_of_a_rigid_motion_are_those_of_moved_cameras() -> None:
    models = distorted_rig()
    slopes = rigid_motion_jacobian(models)
    for column in range(6):
        motion = np.zeros(6)
        motion[column] = 1e-6 if column < 3 else 1e-3
        turn = Rotation.from_rotvec(motion[:3]).as_matrix()
        steps = [step_between(model, transform_world(model, turn, motion[3:])) for model in models]
        assert np.concatenate(steps) / motion[column] == pytest.approx(slopes[:, column], abs=1e-5)


def test_datum_of_a_rigid_motion_is_the_cloud_s_normal_matrix() -> None:
    """Cameras and cloud moved together: ``M'A' J dp = -M'A' A M h``, as no reading changes."""
    models = distorted_rig()
    cameras = CameraStack.of(models)
    points = control_points(9)
    weights = np.random.default_rng(1).uniform(5.0, 15.0, (9, 4))
    weights[2, 1] = 0.0
    slopes = cameras.linearise(points)[1] * weights[..., None]
    middle = points.mean(axis=0)
    turned = np.stack([np.cross(axis, points - middle) for axis in np.eye(3)], axis=2)
    motion = np.concatenate([turned, np.broadcast_to(np.eye(3), (9, 3, 3))], axis=2)
    seen = (slopes @ motion).reshape(-1, 6)
    about_origin = rigid_motion_jacobian(models)
    shift = np.stack([np.cross(middle, axis) for axis in np.eye(3)], axis=1)
    about_middle = about_origin.copy()
    about_middle[:, :3] += about_origin[:, 3:] @ shift
    datum = inner_constraints(cameras, points, weights)
    expected = -seen.T @ seen
    assert datum.T @ about_middle == pytest.approx(expected, rel=1e-6, abs=1e-6)


def test_prior_s_slope_is_that_of_its_difference_far_away() -> None:
    turned = tuple(model.retract(np.array([5.0, 1.0, 0.4, -0.5, 0.3, 2.0, 3.0])) for model in rig())
    prior = SensorPrior(rig(), np.eye(28))
    away, slope = prior.difference(turned)
    for column in range(28):
        sensor, own = divmod(column, 7)
        step = np.zeros(7)
        step[own] = 1e-6
        ahead, behind = list(turned), list(turned)
        ahead[sensor], behind[sensor] = turned[sensor].retract(step), turned[sensor].retract(-step)
        change = prior.difference(ahead)[0] - prior.difference(behind)[0]
        assert change / 2e-6 == pytest.approx(slope[:, column], abs=1e-4)
    assert away[2:5] == pytest.approx([0.4, -0.5, 0.3])


@pytest.mark.parametrize(
    ("shape", "freedom"),
    [
        (line_shape((0.0, 200.0)), 40 * 3 - 22),
        (body_shape(BODY), 40 * 10 - 22),
        (body_shape(BODY, 0.1), 40 * 10 - 22),
        (body_shape(BODY, np.inf, (KnownDistance(0, 1, 100.0, 0.01),)), 40 * 10 - 22 - 5),
    ],
)
def test_redundancies_add_up_to_the_degrees_of_freedom(shape, freedom: int) -> None:
    rng = np.random.default_rng(4)
    poses = nudged(posed(shape, 40, rng, rig()), rng)
    found = adjust(nudged_models(rig(), rng, 0.3), [poses], free_datum=True)
    assert found.dof == freedom
    share = redundancy(found)
    known = 0.0
    if shape.unknowns:  # what the shape's own prior is checked by counts, too
        rows, slopes = found.pose_sets[0].shape.equations()
        own = found.global_covariance[28:, 28:]
        known = len(rows) - float(np.trace(slopes @ own @ slopes.T))
    assert float(share.sum()) + known == pytest.approx(freedom, rel=1e-5)
    assert found.chi2 / freedom == pytest.approx(1.0, abs=5.0 * np.sqrt(2.0 / freedom))


def test_a_wrong_reading_has_the_largest_normalised_residual() -> None:
    bars = _bars(9)
    readings = bars.readings_px.copy()
    readings[17, 1, 2] += 2.0
    found = adjust(rig(), [replace(bars, readings_px=readings)], free_datum=True)
    worst = np.unravel_index(np.abs(normalised_residuals(found)).argmax(), readings.shape)
    assert worst == (17, 1, 2)


def test_robust_loss_bounds_what_a_wrong_reading_does() -> None:
    points, _ = _control(6)
    clean = adjust(rig(), [points])
    readings = points.readings_px.copy()
    readings[3, 0, 1] += 40.0
    wrong = replace(points, readings_px=readings)
    robust = adjust(rig(), [wrong], loss="robust")
    plain = adjust(rig(), [wrong])
    deviation = np.sqrt(np.diagonal(clean.sensor_covariance))
    off = np.abs(_differences(robust) - _differences(clean)) / deviation
    assert off.max() < 2.0
    assert (np.abs(_differences(plain) - _differences(clean)) / deviation).max() > 20.0
    assert robust.weights[0][3, 0, 1] == pytest.approx(3.0 * SIGMA_PX / 40.0, rel=0.1)
    assert (robust.weights[0] < 1.0).sum() == 1
    grown = np.diagonal(robust.sensor_covariance) / np.diagonal(clean.sensor_covariance)
    assert (grown > 1.0 - 1e-3).all()
    assert grown[7:14].max() < 10.0


def test_prior_and_readings_are_weighed() -> None:
    """Without readings of its own a sensor stays at its prior, with the prior's covariance."""
    points, _ = _control(7)
    readings = points.readings_px.copy()
    readings[:, :, 3] = np.nan
    blind = replace(points, readings_px=readings)
    deviation = np.tile([10.0, 5.0, 1e-3, 1e-3, 1e-3, 1.0, 3.0], 4)
    prior = SensorPrior(rig(), np.diag(deviation**-2.0))
    start = nudged_models(rig(), np.random.default_rng(1), 0.1)
    found = adjust(start, [blind], prior=prior)
    assert step_between(rig()[3], found.models[3]) == pytest.approx(0.0, abs=1e-6)
    spread = np.sqrt(np.diagonal(found.sensor_covariance))
    assert spread[21:] == pytest.approx(deviation[21:], rel=1e-6)
    assert (spread[:21] < deviation[:21]).all()


def test_held_parameters_stay_and_are_certain() -> None:
    points, _ = _control(8)
    free = np.ones(28, dtype=np.bool_)
    free[[0, 7, 14, 21]] = False
    start = nudged_models(rig(), np.random.default_rng(3), 0.1)
    found = adjust(start, [points], free=free)
    for before, after in zip(start, found.models, strict=True):
        assert after.principal_distance_px == before.principal_distance_px
        assert after.principal_point_px != before.principal_point_px
    assert (found.sensor_covariance[~free] == 0.0).all()


def test_known_length_gives_an_unknown_body_its_shape() -> None:
    rng = np.random.default_rng(11)
    poses = posed(body_shape(BODY), 60, rng, rig())
    guess = 1.1 * BODY + rng.uniform(-3.0, 3.0, BODY.shape)
    unknown = body_shape(guess, np.inf, (KnownDistance(0, 1, 100.0, 1e-3),))
    found = adjust(rig(), [replace(poses, shape=unknown)], free_datum=True)
    shape = found.pose_sets[0].shape.marker_mm
    between = np.linalg.norm(shape[:, None] - shape[None], axis=2)
    expected = np.linalg.norm(BODY[:, None] - BODY[None], axis=2)
    assert between == pytest.approx(expected, abs=0.5)


def test_resection_is_an_adjustment_of_one_pose_alone() -> None:
    rng = np.random.default_rng(12)
    true = posed(body_shape(BODY), 4, rng, rig())
    start = nudged(true, rng, 5.0)
    found, chi2 = resect(rig(), start)
    held = np.zeros(28, dtype=np.bool_)
    for pose in range(4):
        one = PoseSet(
            start.shape,
            *(
                getattr(start, name)[pose : pose + 1]
                for name in ("translation_mm", "rotation", "readings_px", "sigma_px")
            ),
        )
        alone = adjust(rig(), [one], free=held)
        assert alone.chi2 == pytest.approx(chi2[pose], rel=1e-6)
        assert alone.pose_sets[0].translation_mm[0] == pytest.approx(
            found.translation_mm[pose], abs=1e-4
        )
        assert alone.dof == 10


def test_approach_comes_near_and_says_nothing() -> None:
    rng = np.random.default_rng(13)
    bars = _bars(13)
    start = nudged_models(rig(), rng)
    state = approximate_solution(start, [nudged(bars, rng, 3.0)])
    squares = sum(float((one**2).sum()) for one in state.residuals())
    solution = adjust(state.models, state.pose_sets, free_datum=True)
    assert squares < 1.1 * solution.chi2


@pytest.mark.slow
def test_points_without_a_length_are_refused_by_name() -> None:
    """Free points and free cameras: any projective change fits as well."""
    rng = np.random.default_rng(14)
    points = posed(point_shape(), 100, rng, rig())
    with pytest.raises(UndeterminedParameters, match="combination of parameters open"):
        adjust(rig(), [points], free_datum=True)


def test_a_pose_with_too_few_readings_is_refused() -> None:
    bars = _bars(15)
    readings = bars.readings_px.copy()
    readings[4, 1] = np.nan
    with pytest.raises(UndeterminedParameters, match=r"pose 5 .* its 4 readings"):
        adjust(rig(), [replace(bars, readings_px=readings)], free_datum=True)


def test_frame_must_come_from_somewhere() -> None:
    with pytest.raises(UndeterminedParameters):
        adjust(rig(), [_bars(16)])
    held = np.ones(28, dtype=np.bool_)
    held[0] = False
    with pytest.raises(InvalidParameter, match="free frame"):
        adjust(rig(), [_bars(16)], free=held, free_datum=True)


def test_bad_input_is_named() -> None:
    points, _ = _control(17)
    with pytest.raises(InvalidParameter, match="cubic"):
        adjust([replace(rig()[0], cubic_per_px2=1e-9), *rig()[1:]], [points])
    with pytest.raises(InvalidParameter, match="readings of 4 sensors"):
        adjust(rig(3), [points])
    with pytest.raises(InvalidParameter, match="free has shape"):
        adjust(rig(), [points], free=np.ones(3, dtype=np.bool_))
    behind = replace(points, translation_mm=points.translation_mm - 3.0 * MIDDLE)
    with pytest.raises(NoConvergence, match=r"marker 1 of pose 1 .* behind sensor s1"):
        adjust(rig(), [behind])
    with pytest.raises(InvalidParameter, match="go together"):
        replace(points, known_mm=None)
    with pytest.raises(InvalidParameter, match="positive definite"):
        replace(points, known_covariance_mm2=np.zeros((25, 3, 3)), _information=None)
    with pytest.raises(InvalidParameter, match="must be positive"):
        replace(points, sigma_px=-points.sigma_px)
    with pytest.raises(InvalidParameter, match="lie on a line"):
        body_shape(np.outer(np.arange(3.0), [1.0, 2.0, 3.0]))
    with pytest.raises(InvalidParameter, match="no two may coincide"):
        line_shape((0.0, 0.0))


def test_what_progress_raises_passes_through() -> None:
    class Cancelled(Exception):
        pass

    calls = []

    def tell(fraction: float, stage: str) -> None:
        calls.append((fraction, stage))
        if len(calls) == 3:
            raise Cancelled

    points, _ = _control(18)
    with pytest.raises(Cancelled):
        adjust(nudged_models(rig(), np.random.default_rng(1)), [points], progress=tell)
    assert [stage for _, stage in calls] == ["adjustment"] * 3


def test_two_runs_give_the_same_bits() -> None:
    first = adjust(rig(), [_bars(19)], free_datum=True)
    second = adjust(rig(), [_bars(19)], free_datum=True)
    assert first.models == second.models
    assert (first.global_covariance == second.global_covariance).all()
