"""Cameras from readings alone: projective steps, mirror image, exchanged ends, warnings."""

import re
from dataclasses import replace

import numpy as np
import pytest

import compute.calibration.self_calibration.self_calibrate as module
import validation.wand_from_readings.case as case
from compute.calibration.bundle_adjustment.solver import adjust
from compute.calibration.self_calibration.initial_poses import start_poses
from compute.calibration.self_calibration.metric_upgrade import metric_upgrades
from compute.calibration.self_calibration.pose_screening import (
    check_poses_left,
    find_exchanges,
    pose_curvature,
    screen_poses,
)
from compute.calibration.self_calibration.projective_reconstruction import (
    SEED,
    ProjectiveReconstruction,
    adjust_projective,
    affine_start,
    dual,
)
from compute.calibration.self_calibration.recording_checks import (
    check_certainty,
    check_flat_readings,
    check_scale,
    check_volume_coverage,
    check_wave,
)
from compute.calibration.self_calibration.self_calibrate import self_calibrate
from compute.calibration.self_calibration.targets import Recording, Wand
from compute.calibration.self_calibration.uncalibrated_start import (
    UncalibratedStart,
    direction_vectors,
    handedness,
    mirrored,
    pixel_directions,
    settle_handedness,
    uncalibrated_start,
)
from compute.camera.model import SensorGeometry, SensorModel
from compute.camera.stack import CameraStack
from compute.errors import (
    DegeneratePoints,
    InvalidParameter,
    LumilineError,
    NoConvergence,
    TooFewPoints,
    UndeterminedParameters,
)
from tests.compute.calibration.self_calibration.scenes import (
    MIDDLE,
    SIGMA_PX,
    WAND_MM,
    bars,
    noisy,
    wand_markers,
)
from tests.compute.rig import rig

WAND = Wand((0.0, WAND_MM))


def _geometry(count: int = 4) -> list[SensorGeometry]:
    return [SensorGeometry(model.name, model.pixels) for model in rig()[:count]]


def _recording(seed: int = 1, poses: int = 60) -> Recording:
    rng = np.random.default_rng(seed)
    read = noisy(rig(), wand_markers(poses, rng), rng)
    return Recording(WAND, read, np.full(read.shape, SIGMA_PX))


def test_projective_adjustment_reaches_the_noise_despite_wrong_readings() -> None:
    readings = _recording().readings_px.reshape(-1, 4).copy()
    readings[[3, 40], [1, 2]] += 300.0
    normalised = (readings - readings.mean(axis=0)) / 300.0
    found = adjust_projective(affine_start(normalised))
    misfit = found.point_misfits() * 300.0
    assert np.median(misfit) < 1.2 * SIGMA_PX
    assert (misfit[[3, 40]] > 20.0 * SIGMA_PX).all()


def test_dual_of_four_cameras_fits_as_well() -> None:
    readings = _recording().readings_px.reshape(-1, 4)
    normalised = (readings - readings.mean(axis=0)) / 300.0
    found = adjust_projective(affine_start(normalised))
    other = dual(found)
    assert np.median(other.point_misfits()) < 2.0 * np.median(found.point_misfits())


def test_mirror_image_reads_the_same() -> None:
    points = wand_markers(20, np.random.default_rng(2)).reshape(-1, 3)
    read = CameraStack.of(rig()).project(points)
    image = CameraStack.of(mirrored(rig())).project(points * [-1.0, 1.0, 1.0])
    assert image == pytest.approx(read, abs=1e-9)


def test_described_directions_settle_the_mirror_image() -> None:
    described = pixel_directions(rig())
    assert handedness(rig(), described) > 0.9
    assert handedness(mirrored(rig()), described) < -0.9
    for models in (rig(), mirrored(rig())):
        settled, doubt = settle_handedness(models, described)
        assert handedness(settled, described) > 0.9
        assert doubt == ""
    assert "mirror image" in settle_handedness(rig(), None)[1]
    alike = direction_vectors([30.0] * 4)
    assert "not all slits are parallel" in settle_handedness(rig(), alike)[1]


@pytest.mark.slow
def test_calibration_without_initial_cameras_equals_one_from_the_truth() -> None:
    recording = _recording(3, 100)
    degrees = np.rad2deg(np.arctan2(*pixel_directions(rig()).T[::-1])).tolist()
    found = self_calibrate(_geometry(), [recording], directions_deg=degrees)
    right = self_calibrate(rig(), [recording])
    assert found.chi2_per_dof == pytest.approx(right.chi2_per_dof, rel=1e-3)
    assert found.device_scale is None
    assert found.warnings == ()
    for one, other in zip(found.calibration.models, right.calibration.models, strict=True):
        assert one.principal_distance_px == pytest.approx(other.principal_distance_px, rel=1e-3)
    described = self_calibrate(rig(), [recording], initial="readings")
    assert described.chi2_per_dof == pytest.approx(right.chi2_per_dof, rel=1e-3)
    assert described.device_scale == pytest.approx(right.device_scale, rel=1e-3)
    unsettled = self_calibrate(_geometry(), [recording])
    assert "mirror image" in unsettled.warnings[0]


def test_exchanged_ends_of_one_sensor_are_found() -> None:
    recording = _recording(4, 12)
    readings = recording.readings_px.copy()
    readings[5, :, 2] = readings[5, ::-1, 2]
    changed = replace(recording, readings_px=readings)
    assert changed.sigma_px is not None
    start = start_poses(rig(), changed, changed.sigma_px)
    bad = start.poses.select(np.arange(12) == 5)
    assert find_exchanges(rig(), bad) == [(0, 0, 1, 2)]
    readings[5, 0, 2] += 15.0
    bad = replace(bad, readings_px=readings[5:6])
    assert find_exchanges(rig(), bad) == []


def test_exchanged_ends_are_exchanged_back_and_named() -> None:
    recording = _recording(5, 40)
    readings = recording.readings_px.copy()
    readings[[5, 20], :, 2] = readings[[5, 20], ::-1, 2]
    found = self_calibrate(rig(), [replace(recording, readings_px=readings)])
    assert {(one.pose, one.sensor) for one in found.exchanged} == {
        (6, rig()[2].name),
        (21, rig()[2].name),
    }
    assert found.targets[0].used == 40


def test_missing_readings_do_not_contradict_the_rest() -> None:
    recording = _recording(6, 100)
    rng = np.random.default_rng(7)
    readings = np.where(rng.random((100, 2, 4)) < 0.3, np.nan, recording.readings_px)
    found = self_calibrate(rig(), [replace(recording, readings_px=readings)])
    complete = (np.isfinite(readings).sum(axis=2) >= 3).all(axis=1)
    assert found.targets[0].used == complete.sum() < 60


def test_a_scale_that_differs_from_the_start_is_warned_of() -> None:
    read = _recording(8, 40)
    longer = replace(read, target=Wand((0.0, 1.05 * WAND_MM)))
    found = self_calibrate(rig(), [longer])
    assert len(found.warnings) == 1
    assert found.device_scale == pytest.approx(1.05, abs=0.02)
    assert f"{found.device_scale:.4g} times as large" in found.warnings[0]
    assert found.calibration.diagnosis is not None
    assert found.calibration.diagnosis.remarks == found.warnings
    assert self_calibrate(rig(), [read]).warnings == ()


@pytest.mark.slow
def test_cameras_that_leave_more_than_the_noise_are_attempted_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def first_attempt_fails(
        sensors: list[SensorGeometry], recordings: list[Recording], seed: int
    ) -> UncalibratedStart:
        seeds.append(seed)
        found = uncalibrated_start(sensors, recordings, seed)
        if len(seeds) > 1:
            return found
        wrong = [
            replace(one, principal_distance_px=0.5 * one.principal_distance_px)
            for one in found.models
        ]
        return replace(found, models=tuple(wrong))

    seeds: list[int] = []
    monkeypatch.setattr(module, "uncalibrated_start", first_attempt_fails)
    found = self_calibrate(_geometry(), [_recording()])
    assert seeds == [SEED, SEED + 1]
    assert found.chi2_per_dof < 2.0
    assert not any("may be wrong" in warning for warning in found.warnings)


@pytest.mark.slow
def test_readings_with_more_noise_than_stated_are_warned_of() -> None:
    recording = _recording()
    assert recording.sigma_px is not None
    optimistic = replace(recording, sigma_px=recording.sigma_px / 2.5)
    found = self_calibrate(_geometry(), [optimistic])
    assert any("may be wrong" in warning for warning in found.warnings)


def test_what_cannot_start_from_readings_is_refused() -> None:
    recording = _recording(9, 40)
    three = Recording(WAND, recording.readings_px[..., :3])
    with pytest.raises(TooFewPoints, match="3 sensors; cameras without initial values need four"):
        uncalibrated_start(_geometry(3), [three])
    few = recording.readings_px.copy()
    few[5:, :, 0] = np.nan
    with pytest.raises(TooFewPoints, match="10 markers were read by four sensors"):
        uncalibrated_start(_geometry(), [Recording(WAND, few)])
    with pytest.raises(InvalidParameter, match="leave them out"):
        self_calibrate(rig(), [recording], directions_deg=[0.0] * 4)
    with pytest.raises(InvalidParameter, match="has 3 angles"):
        self_calibrate(_geometry(), [recording], directions_deg=[0.0] * 3)
    with pytest.raises(InvalidParameter, match='"auto", which needs control points'):
        self_calibrate(_geometry(), [recording], distortion="auto")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("axes", "reason"), [((1.0, 0.0, 0.0), "all parallel"), ((1.0, 1.0, 0.0), "all in one plane")]
)
def test_degenerate_waves_are_named(axes: tuple[float, ...], reason: str) -> None:
    rng = np.random.default_rng(10)
    middles, along = rng.uniform(-150.0, 150.0, (80, 3)), rng.standard_normal((80, 3)) * axes
    read = noisy(rig(), bars(MIDDLE + middles, along), rng)
    with pytest.raises(DegeneratePoints, match=reason):
        self_calibrate(_geometry(), [Recording(WAND, read)])


def test_a_flat_cloud_is_known_from_its_readings_alone() -> None:
    rng = np.random.default_rng(11)
    middles, along = rng.uniform(-150.0, 150.0, (80, 3)), rng.standard_normal((80, 3))
    check_flat_readings([Recording(WAND, noisy(rig(), bars(MIDDLE + middles, along), rng))])
    flat = [1.0, 1.0, 0.0]
    read = noisy(rig(), bars(MIDDLE + middles * flat, along * flat), rng)
    read[3, 0, 1] += 700.0
    with pytest.raises(DegeneratePoints, match="all in one plane"):
        check_flat_readings([Recording(WAND, read)])


def test_a_short_bar_far_from_a_volume_does_not_make_it_flat() -> None:
    """Depth changes its readings by 2 % of what the other directions do."""
    wave = case.draw_wave(next(row for row in case.ROWS if row.always), 18001, 5)
    sigma = np.full(wave.readings_px.shape, wave.sigma_px)
    wand = Wand((0.0, wave.bar.wand_mm))
    check_flat_readings([Recording(wand, wave.readings_px, sigma)])
    flat = wave.bar.read(wave.markers_mm * [1.0, 1.0, 0.0] + [0.0, 0.0, wave.bar.centre_mm[2]])
    with pytest.raises(DegeneratePoints, match="all in one plane"):
        check_flat_readings([Recording(wand, flat, sigma)])


def test_markers_of_unnoticed_wrong_readings_may_lie_beyond_infinity() -> None:
    rng = np.random.default_rng(14)
    models, markers = rig(), wand_markers(50, rng).reshape(-1, 3)
    forward = np.array([np.append(one.rotation[2], one.offset_z_mm) for one in models])
    right = np.array([np.append(one.rotation[0], one.offset_x_mm) for one in models])
    inner = np.array([(one.principal_distance_px, one.principal_point_px) for one in models])
    first = inner[:, :1] * right + inner[:, 1:] * forward
    cameras, readings = np.stack([first, forward], axis=1), CameraStack.of(models).project(markers)
    points, pairs = np.column_stack([markers, np.ones(100)]), np.arange(100).reshape(-1, 2)
    wrong = points.copy()
    wrong[[10, 30, 50, 70], 2:] = (3000.0, -1.0)
    distances = []
    for one in (points, wrong):
        reconstruction = ProjectiveReconstruction(cameras, one, readings)
        found = metric_upgrades(reconstruction, pairs, np.full(50, WAND_MM), _geometry())
        distances.append([model.principal_distance_px for model in found[0][1]])
    np.testing.assert_allclose(distances[1], distances[0], rtol=0.1)


def test_a_pose_between_two_solutions_does_not_stop_the_adjustment() -> None:
    """With it 2000 steps were too few, from the true cameras, too."""
    wave = case.draw_wave(next(row for row in case.ROWS if row.always), 93001, 31)
    sigma = np.full(wave.readings_px.shape, wave.sigma_px)
    recording = Recording(Wand((0.0, wave.bar.wand_mm)), wave.readings_px, sigma)
    found = self_calibrate(case.true_models(wave.bar), [recording])
    assert found.chi2_per_dof < 1.5
    start = start_poses(found.calibration.models, recording, sigma)
    fitted = screen_poses(found.calibration.models, start).consistent.poses
    curvature = pose_curvature(found.calibration.models, fitted)
    assert (curvature > 1.0).sum() == 1
    assert np.median(curvature) < 0.01


def test_uncertain_cameras_are_explained_by_directions_on_a_cone() -> None:
    rng = np.random.default_rng(12)
    models = rig()
    middles, along = rng.uniform(-150.0, 150.0, (80, 3)), rng.standard_normal((80, 3))
    recording = Recording(WAND, noisy(models, bars(MIDDLE + middles, along), rng))
    start = start_poses(models, recording, np.full(recording.readings_px.shape, 1.0)).poses
    adjusted = adjust(models, [start], free_datum=True)
    assert check_certainty(adjusted, [recording], [start]) == ""
    count = len(adjusted.global_covariance)
    hardly = replace(adjusted, global_covariance=1e5 * np.eye(count))
    warning = check_certainty(hardly, [recording], [start])
    assert re.search(r"principal distance of sensor s\d to 1\d % only", warning)
    unknown = replace(adjusted, global_covariance=1e8 * np.eye(count))
    with pytest.raises(UndeterminedParameters, match=r"of sensor s\d open: .* 33\d %"):
        check_certainty(unknown, [recording], [start])
    along[:, 2] = 0.7 * np.linalg.norm(along[:, :2], axis=1) * rng.uniform(0.9, 1.1, 80)
    cone = Recording(WAND, noisy(models, bars(MIDDLE + middles, along), rng))
    start = start_poses(models, cone, np.full(cone.readings_px.shape, 1.0)).poses
    check_volume_coverage([start])
    certain = replace(adjusted, global_covariance=np.eye(count))
    check_certainty(certain, [cone], [start])
    uncertain = replace(adjusted, global_covariance=1e4 * np.eye(count))
    with pytest.raises(DegeneratePoints, match="on a cone"):
        check_certainty(uncertain, [cone], [start])


def test_size_that_the_start_sees_right_is_the_searchs_fault() -> None:
    models = rig()
    small = [scaled(model, 0.1) for model in models]
    check_scale(models, models, [1.0])
    with pytest.raises(NoConvergence, match=r"0\.1 times as large .* sees the known lengths right"):
        check_scale(models, small, [1.05])
    with pytest.raises(InvalidParameter, match="were they given in cm"):
        check_scale(models, small, [10.2])


def test_recording_without_a_pose_that_agrees_is_named() -> None:
    recording = _recording(14)
    sigma = np.full(recording.readings_px.shape, SIGMA_PX)
    start = start_poses(rig(), recording, sigma)
    none = start.select(np.zeros(len(start.poses), dtype=np.bool_))
    check_poses_left([start, start])
    with pytest.raises(NoConvergence, match="no pose of recording 2 agrees"):
        check_poses_left([start, none])


@pytest.mark.slow
def test_readings_of_no_wand_are_refused() -> None:
    rng = np.random.default_rng(14)
    recording = _recording(14)
    shuffled = rng.permuted(recording.readings_px.reshape(-1, 4), axis=0)
    shuffled = shuffled.reshape(recording.readings_px.shape)
    with pytest.raises(LumilineError):
        self_calibrate(rig(), [replace(recording, readings_px=shuffled)])


def scaled(model: SensorModel, scale: float) -> SensorModel:
    return replace(
        model, offset_x_mm=scale * model.offset_x_mm, offset_z_mm=scale * model.offset_z_mm
    )


def test_flat_wave_and_directions_on_a_cone_are_both_named() -> None:
    rng = np.random.default_rng(13)
    models, flat = rig(), [1.0, 1.0, 0.0]
    middles, along = rng.uniform(-150.0, 150.0, (80, 3)), rng.standard_normal((80, 3))
    recording = Recording(WAND, noisy(models, bars(MIDDLE + middles * flat, along * flat), rng))
    start = start_poses(models, recording, np.full(recording.readings_px.shape, 1.0)).poses
    with pytest.raises(DegeneratePoints, match=r"all in one plane: .*; or the 80 known"):
        check_wave([recording], [start])
