"""Every status is reached by a scene; poses are as uncertain as they say, and never stale."""

from dataclasses import replace

import numpy as np
import pytest

from compute.camera.stack import CameraStack
from compute.errors import InvalidParameter
from compute.mapping.grid import VoxelGrid
from compute.mapping.table import CorrectionTable
from compute.measurement.measurements import Measurements
from compute.pose.estimation.pose_fit import fit_pose
from compute.pose.filtering.pose_filter import predict
from compute.pose.rigid_body import PoseStatus, RigidBody, ToolPose
from compute.pose.settings import MotionSettings, ToolTrackerSettings
from compute.pose.tool_tracking.tool_tracker import ToolTracker
from compute.signal.peaks import PeakFlag
from compute.transform import rotation_matrix, rotation_vector
from tests.compute.pose.scene import (
    CALIBRATION,
    CAMERAS,
    MIDDLE_MM,
    PIXELS_OF_ALL,
    SIGMA_PX,
    Array,
    Body,
    Scene,
    body,
    normalised,
    other,
    pointer,
)
from tests.compute.rig import rig

SETTINGS = ToolTrackerSettings()
QUIET = MotionSettings(acceleration_mm_s2=300.0, angular_acceleration_rad_s2=3.0)
"""Of the scenes whose tools move by the very noise that the filter expects."""


def scene(
    tools: list, settings: ToolTrackerSettings = SETTINGS, *, seed: int = 0, **more: object
) -> Scene:
    bodies = [
        body(tool, seed + index, MIDDLE_MM + np.array([140.0 * index, 30.0 * index, 0.0]))
        for index, tool in enumerate(tools)
    ]
    tracker = ToolTracker(CAMERAS, tools, settings, pixels=PIXELS_OF_ALL)
    return Scene(bodies, tracker, seed=seed, **more)  # type: ignore[arg-type]


def agitate(one: Body, motion: MotionSettings, step_s: float, rng: np.random.Generator) -> None:
    """Change a body's velocities by the noise that the filter expects, halfway of a step."""
    for name, size in (
        ("velocity_mm_s", motion.acceleration_mm_s2),
        ("angular_velocity_rad_s", motion.angular_acceleration_rad_s2),
    ):
        sd = np.sqrt(2.0 * size**2 * motion.manoeuvre_time_constant_s * step_s)
        setattr(one, name, getattr(one, name) + sd * rng.standard_normal(3))


def squares(
    *, strobed: bool, moving: bool, covariance: Array | None, runs: int = 10, frames: int = 60
) -> Array:
    """Normalised errors of poses and tips, of runs with a calibration of their own, (n, 2)."""
    found = []
    tool = replace(pointer(strobed=strobed), max_tip_sd_mm=10.0)
    for seed in range(runs):
        rng = np.random.default_rng(100 + seed)
        cameras = CAMERAS
        if covariance is not None:
            step = np.sqrt(np.diag(covariance)) * rng.standard_normal(28)
            cameras = CAMERAS.retract(step.reshape(4, 7))
        tracker = ToolTracker(
            CAMERAS, [tool], replace(SETTINGS, motion=QUIET), parameter_covariance=covariance
        )
        true = body(tool, seed)
        one = Scene([true], tracker, cameras, seed=seed, covariance=covariance)
        if moving:
            true.velocity_mm_s = 100.0 * rng.standard_normal(3)
            true.angular_velocity_rad_s = rng.standard_normal(3)
        for frame in range(frames):
            before = replace(true)
            (pose,) = one.strobed() if strobed else one.together()
            if moving:
                agitate(true, QUIET, 1e-3, rng)
            if frame > 20 and frame % 3 == 0:
                assert pose.status is PoseStatus.OK, pose.reason
                found.append(normalised(pose, before))
    return np.array(found)


def swinging(tool: RigidBody, seed: int, time_ms: int) -> Body:
    """A tool that swings by 100 mm and 0.5 rad: up to 0.9 m/s^2 and 8 rad/s^2."""
    rng = np.random.default_rng(seed)
    axis, way = (one / np.linalg.norm(one) for one in rng.standard_normal((2, 3)))
    rest = body(tool, seed)
    turn = rotation_matrix(0.5 * np.sin(4e-3 * time_ms) * axis)
    return Body(tool, turn @ rest.rotation, MIDDLE_MM + 100.0 * np.sin(3e-3 * time_ms) * way)


def see(
    tracker: ToolTracker, true: Body, time_ms: int, marker: int, rng: np.random.Generator
) -> ToolPose:
    """The pose after an exposure of one marker."""
    reading = CAMERAS.project(true.markers_mm)[marker] + SIGMA_PX * rng.standard_normal(4)
    flags = np.zeros((4, 1), dtype=np.int32)
    (pose,) = tracker.step(
        1_000_000 * time_ms,
        time_ms,
        Measurements.of(reading[:, None], np.full((4, 1), SIGMA_PX), flags),
        marker,
    )
    return pose


@pytest.mark.slow
@pytest.mark.parametrize("strobed", [True, False])
@pytest.mark.parametrize("covariance", [None, CALIBRATION], ids=["exact", "calibrated"])
def test_moving_tools_are_as_uncertain_as_they_say(strobed: bool, covariance: Array | None) -> None:
    found = squares(strobed=strobed, moving=True, covariance=covariance)
    # Errors of one run are alike: there are 10 draws of a calibration, and some more of the noise.
    pose, tip = found.mean(axis=0)
    assert 3.8 < pose < 9.0
    assert 1.5 < tip < 5.2


@pytest.mark.parametrize(
    "covariance",
    [
        pytest.param(None, marks=pytest.mark.slow, id="exact"),
        pytest.param(CALIBRATION, id="calibrated"),
    ],
)
def test_tools_at_rest_are_never_more_uncertain_than_the_filter_assumes(
    covariance: Array | None,
) -> None:
    found = squares(strobed=True, moving=False, covariance=covariance)
    assert 2.0 < found[:, 0].mean() < 8.0


def test_the_calibrations_part_is_not_averaged_away() -> None:
    still = MotionSettings(acceleration_mm_s2=1e-3, angular_acceleration_rad_s2=1e-5)
    tool = pointer()
    deviations = []
    for covariance in (None, CALIBRATION):
        tracker = ToolTracker(
            CAMERAS, [tool], replace(SETTINGS, motion=still), parameter_covariance=covariance
        )
        one = Scene([body(tool)], tracker, covariance=covariance)
        poses = [one.together()[0] for _ in range(150)]
        deviations.append(
            [np.sqrt(np.trace(pose.tip_covariance_mm2)) for pose in (poses[1], poses[-1])]
        )
    exact, calibrated = deviations
    assert exact[1] < 0.2 * exact[0]
    assert calibrated[1] > 0.5 * calibrated[0]


def test_a_fast_strobed_tool_has_a_pose_at_every_frame() -> None:
    one = scene([pointer(strobed=True)])
    true = one.bodies[0]
    true.velocity_mm_s = np.array([400.0, -100.0, 50.0])
    true.angular_velocity_rad_s = np.array([1.0, 3.0, -1.0])
    errors = []
    for frame in range(80):
        before = replace(true)
        (pose,) = one.strobed()
        if frame > 20:
            assert pose.valid, pose.reason
            assert pose.exposure_ns == frame * 1_000_000
            assert pose.sequence == frame
            errors.append(np.abs(pose.tip_mm - before.tip_world_mm).max())
    # In the four frames of a cycle the markers move 1.6 mm and turn 13 mrad.
    assert np.sqrt(np.mean(np.square(errors))) < 0.4
    assert pose.velocity_mm_s == pytest.approx(
        true.velocity_mm_s
        + np.cross(true.angular_velocity_rad_s, true.translation_mm - true.centroid_mm),
        abs=80.0,
    )
    assert pose.angular_velocity_rad_s == pytest.approx(true.angular_velocity_rad_s, abs=1.5)


def test_bursts_far_apart_are_followed_around_the_curve() -> None:
    # Four exposures, then 80 ms of other tools': it turns by 0.1 rad until it is seen again.
    ratios = []
    for seed in range(2):
        rng = np.random.default_rng(seed)
        tool = replace(pointer(strobed=True), max_tip_sd_mm=20.0)
        tracker = ToolTracker(CAMERAS, [tool])
        for exposure in range(160):
            time_ms = 84 * (exposure // 4) + exposure % 4
            true = swinging(tool, seed, time_ms)
            pose = see(tracker, true, time_ms, exposure % 4, rng)
            if pose.valid:
                assert pose.tip_mm is not None
                assert pose.tip_covariance_mm2 is not None
                off = np.linalg.norm(pose.tip_mm - true.tip_world_mm)
                ratios.append(off / np.sqrt(np.trace(pose.tip_covariance_mm2)))
    assert len(ratios) > 75
    assert max(ratios) < 4.0


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_frames_are_lost_and_no_wrong_pose_is_ok(seed: int) -> None:
    rng = np.random.default_rng(seed)
    tool = pointer(strobed=True)
    tracker = ToolTracker(CAMERAS, [tool], pixels=PIXELS_OF_ALL)
    frame = ok = 0
    while frame < 15_000:
        if rng.random() < 0.04:
            frame += int(rng.integers(1, 400))
        true = swinging(tool, seed, frame)
        pose = see(tracker, true, frame, frame % 4, rng)
        if pose.valid:
            ok += 1
            assert pose.tip_mm is not None
            assert pose.tip_covariance_mm2 is not None
            off = float(np.linalg.norm(pose.tip_mm - true.tip_world_mm))
            stated = float(np.sqrt(np.trace(pose.tip_covariance_mm2)))
            assert off < 6.0 * stated, (frame, off, stated)
        frame += 1
    assert ok > 500


def test_not_looked_for_is_unknown_then_missing_says_how_many_were_seen() -> None:
    tracker = ToolTracker(CAMERAS, [pointer(strobed=True)])
    nothing = np.full((4, 1), np.nan)
    flags = np.zeros((4, 1), dtype=np.int32)
    (pose,) = tracker.step(0, 0, Measurements.of(nothing, nothing, flags), 17)
    assert pose.status is PoseStatus.UNKNOWN
    (pose,) = tracker.step(1, 1, Measurements.of(nothing, nothing, flags), 2)
    assert pose.status is PoseStatus.MISSING
    assert "0 of 4 markers were seen in the last 250 ms" in str(pose.reason)
    one = scene([pointer(strobed=True)])
    reasons = [str(one.strobed()[0].reason) for _ in range(3)]
    assert [reason[:6] for reason in reasons] == ["1 of 4", "2 of 4", "3 of 4"]


@pytest.mark.parametrize("strobed", [True, False])
def test_a_hidden_tool_is_never_ok_for_longer_than_the_coast(strobed: bool) -> None:
    one = scene([pointer(strobed=strobed)])
    for _ in range(40):
        (pose,) = one.strobed() if strobed else one.together()
    assert pose.valid
    last_ns = pose.exposure_ns
    everything = tuple((marker, None) for marker in range(4))
    statuses = []
    for _ in range(200):
        (pose,) = one.strobed(blind=True) if strobed else one.together(everything)
        statuses.append(pose.status)
        if pose.exposure_ns - last_ns > 1e9 * SETTINGS.coast_s:
            assert pose.status is PoseStatus.MISSING
            assert pose.rotation is None
            assert pose.reason
    assert statuses[0] is PoseStatus.OK
    # The stated deviation grows while nothing is seen, until it is too large to use.
    order = [PoseStatus.OK, PoseStatus.HIGH_ERROR, PoseStatus.MISSING]
    ranks = [order.index(status) for status in statuses]
    assert ranks == sorted(ranks)
    for _ in range(40):
        (pose,) = one.strobed() if strobed else one.together()
    assert pose.valid
    assert pose.tip_mm == pytest.approx(one.bodies[0].tip_world_mm, abs=1.0)


def test_a_tool_that_leaves_is_out_of_view() -> None:
    one = scene([pointer()])
    one.bodies[0].velocity_mm_s = np.array([3000.0, 0.0, 0.0])
    statuses = [one.together()[0].status for _ in range(320)]
    assert statuses[1] is PoseStatus.OK
    assert statuses[-1] is PoseStatus.OUT_OF_VIEW
    (pose,) = one.together()
    assert "left the sensors' fields" in str(pose.reason)
    assert pose.rotation is None


def test_a_tool_that_is_gone_out_of_view_stays_so() -> None:
    one = scene([pointer()])
    one.bodies[0].velocity_mm_s = np.array([3000.0, 0.0, 0.0])
    everything = tuple((marker, None) for marker in range(4))
    # Hidden from 500 mm on, heading for where no sensor sees it.
    poses = [one.together(() if frame < 166 else everything)[0] for frame in range(320)]
    assert poses[-1].status is PoseStatus.OUT_OF_VIEW
    assert "nothing was seen of it for 100 ms" in str(poses[-1].reason)
    one.bodies[0].centroid_mm = MIDDLE_MM
    one.bodies[0].velocity_mm_s = np.zeros(3)
    one.together()
    assert one.together()[0].valid


def test_after_a_gap_of_frames_a_tool_is_found_anew() -> None:
    one = scene([pointer(strobed=True)])
    for _ in range(40):
        (pose,) = one.strobed()
    assert pose.valid
    one.sequence += 152
    (pose,) = one.strobed()
    assert pose.status is PoseStatus.MISSING
    assert "1 of 4 markers were seen" in str(pose.reason)
    for _ in range(12):
        (pose,) = one.strobed()
    assert pose.valid


def test_a_found_tool_knows_its_share_of_the_calibrations_errors() -> None:
    true = body(pointer(), 5)
    root = np.sqrt(np.diag(CALIBRATION))
    tracker = ToolTracker(CAMERAS, [pointer()], parameter_covariance=CALIBRATION)
    (found,) = Scene([true], tracker, covariance=CALIBRATION).together()
    assert found.valid
    state = tracker._tools[0].state
    assert state is not None
    columns = tracker.model.covariance_factor.reshape(28, -1)
    assert columns @ columns.T == pytest.approx(CALIBRATION, abs=1e-12)
    for error in range(0, 28, 5):
        # Cameras that are off by one deviation of this error, and no noise.
        step = columns[:, error].reshape(4, 7)
        assert (np.abs(step.ravel()) <= 1.01 * root).all()
        readings = CAMERAS.retract(step).project(true.markers_mm)
        fit = fit_pose(tracker.model, true.tool, readings, np.full(4, SIGMA_PX))
        assert fit.rotation is not None
        assert fit.translation_mm is not None
        turn = rotation_vector(true.rotation @ fit.rotation.T)
        centroid = fit.translation_mm + fit.rotation @ true.tool.markers_mm.mean(axis=0)
        off = np.concatenate([turn, true.centroid_mm - centroid])
        assert state.common[:6, error] == pytest.approx(off, rel=0.05, abs=2e-3 * np.abs(off).max())


def test_outside_of_the_volume_there_is_a_pose_and_a_status() -> None:
    low, high = (-100.0, -300.0, 1300.0), (100.0, 300.0, 1700.0)
    one = scene([pointer()], replace(SETTINGS, volume_mm=(low, high)))
    one.bodies[0].velocity_mm_s = np.array([1000.0, 0.0, 0.0])
    poses = [one.together()[0] for _ in range(150)]
    statuses = [pose.status for pose in poses]
    assert statuses[-1] is PoseStatus.OUT_OF_VOLUME
    assert PoseStatus.OK in statuses
    assert "outside of the volume of the calibration" in str(poses[-1].reason)
    assert poses[-1].tip_mm == pytest.approx(one.bodies[0].tip_world_mm - [1.0, 0, 0], abs=1.0)
    with pytest.raises(InvalidParameter, match="volume_mm"):
        ToolTrackerSettings(volume_mm=(high, low))


def test_beyond_the_correction_table_is_out_of_volume_and_its_doubt_stays() -> None:
    grid = VoxelGrid((-300.0, -300.0, 1200.0), (100.0, 100.0, 100.0), (6, 6, 6))
    valid = np.ones((4, 6, 6, 6), dtype=bool)
    valid[:, 4:] = False
    tables = [
        CorrectionTable(
            tuple(model.name for model in rig()),
            "",
            grid,
            1,
            np.zeros((4, 7, 7, 7)),
            np.full((4, 7, 7, 7), variance),
            valid,
        )
        for variance in (1e-6, 0.01)
    ]
    deviations = []
    still = MotionSettings(acceleration_mm_s2=1e-3, angular_acceleration_rad_s2=1e-5)
    for table in tables:
        tracker = ToolTracker(
            CAMERAS, [pointer()], replace(SETTINGS, motion=still), corrections=table
        )
        one = Scene([body(pointer())], tracker)
        poses = [one.together()[0] for _ in range(100)]
        assert poses[-1].valid, poses[-1].reason
        deviations.append(np.sqrt(np.trace(poses[-1].tip_covariance_mm2)))
    # 0.1 px of the table is the same in all 100 frames; 0.05 px of noise is not.
    assert deviations[1] > 8.0 * deviations[0]
    far = body(pointer(), 0, MIDDLE_MM + np.array([200.0, 0.0, 0.0]))
    tracker = ToolTracker(CAMERAS, [pointer()], corrections=tables[0])
    (pose,) = Scene([far], tracker).together()
    assert pose.status is PoseStatus.OUT_OF_VOLUME
    assert "correction table is not valid" in str(pose.reason)
    assert pose.covariance is not None
    # Beyond the table itself nothing says how certain the pose is.
    far = body(pointer(), 0, MIDDLE_MM + np.array([420.0, 0.0, 0.0]))
    tracker = ToolTracker(CAMERAS, [pointer()], corrections=tables[0])
    (pose,) = Scene([far], tracker).together()
    assert pose.status is PoseStatus.OUT_OF_VOLUME
    assert "beyond the correction table" in str(pose.reason)
    assert pose.translation_mm is not None
    assert pose.covariance is None
    assert pose.tip_covariance_mm2 is None


def test_readings_of_a_bent_tool_are_invalid() -> None:
    bent = pointer(strobed=True).markers_mm.copy()
    bent[3] += [0.0, 0.0, 4.0]
    one = scene([pointer(strobed=True)])
    one.bodies[0].tool = replace(one.bodies[0].tool, markers_mm=bent)
    poses = [one.strobed()[0] for _ in range(60)]
    assert not any(pose.valid for pose in poses)
    reasons = [str(pose.reason) for pose in poses if pose.status is PoseStatus.INVALID]
    assert len(reasons) > 20
    assert all("do not fit" in reason for reason in reasons)


def bent_a_little(marker: int, axis: int, *, strobed: bool, seed: int) -> Scene:
    """A tool one marker of which is not where it is believed to be, 25 deviations off."""
    tool = pointer(strobed=strobed)
    one = scene([tool], seed=seed)
    bent = tool.markers_mm.copy()
    bent[marker, axis] += 1.25
    one.bodies[0].tool = replace(tool, markers_mm=bent)
    return one


@pytest.mark.slow
@pytest.mark.parametrize("strobed", [True, False])
def test_a_marker_that_is_bent_a_little_makes_no_wrong_pose_ok(strobed: bool) -> None:
    ok, reasons = 0, []
    for seed in range(3):
        for marker in range(4):
            for axis in range(3):
                one = bent_a_little(marker, axis, strobed=strobed, seed=seed)
                for _ in range(24):
                    before = replace(one.bodies[0])
                    (pose,) = one.strobed() if strobed else one.together()
                    reasons.append(str(pose.reason))
                    if pose.valid:
                        ok += 1
                        assert pose.tip_mm is not None
                        # The readings left say so little that a bend of 1.25 mm may hide there.
                        assert np.linalg.norm(pose.tip_mm - before.tip_world_mm) < 5.0
    # Where the sensors tell the bend hardly, the pose suffers hardly.
    assert ok < 0.02 * len(reasons)
    assert any("does not fit the tool's geometry" in reason for reason in reasons)


@pytest.mark.parametrize(
    "seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))]
)
@pytest.mark.parametrize("strobed", [True, False])
def test_a_tool_that_is_not_bent_stays_ok(strobed: bool, seed: int) -> None:
    one = scene([pointer(strobed=strobed)], seed=seed)
    one.bodies[0].velocity_mm_s = np.array([200.0, 0.0, 100.0])
    one.bodies[0].angular_velocity_rad_s = np.array([0.5, 0.0, 1.0])
    found = [(one.strobed() if strobed else one.together())[0].valid for _ in range(200)]
    assert sum(found[16:]) >= len(found[16:]) - 1


def test_readings_that_are_left_out_again_and_again_are_told_by_their_marker() -> None:
    one = scene([pointer()])
    for _ in range(8):
        (pose,) = one.together()
    assert pose.valid
    reading = one.readings()[0]
    poses = []
    for _ in range(6):
        # One sensor alone sees marker 3 off by 30 deviations.
        reading = one.readings()[0]
        reading[2, 1] += 1.5
        poses += one._step(np.sort(reading.T, axis=1), None, None)
    assert [pose.valid for pose in poses] == [True, True] + [False] * 4
    assert poses[-1].status is PoseStatus.INVALID
    assert "marker 3 does not fit the tool's geometry" in str(poses[-1].reason)
    for _ in range(4):
        (pose,) = one.together()
    assert pose.valid


@pytest.mark.parametrize(
    "sensors",
    [(0, 1), (2, 3)]
    + [pytest.param(pair, marks=pytest.mark.slow) for pair in ((0, 2), (0, 3), (1, 2), (1, 3))],
)
def test_a_strobed_tool_that_two_sensors_see_is_found_or_they_are_too_few(
    sensors: tuple[int, int],
) -> None:
    one = scene([pointer(strobed=True)])
    reasons = []
    for frame in range(80):
        before = replace(one.bodies[0])
        reading = one.readings()[0][frame % 4]
        reading[list(sensors)] = np.nan
        (pose,) = one._step(reading[:, None], frame % 4, None)
        assert pose.status is not PoseStatus.INVALID, pose.reason
        reasons.append(str(pose.reason))
        if pose.rotation is not None:
            assert pose.tip_mm == pytest.approx(before.tip_world_mm, abs=3.0)
    assert pose.rotation is not None or any(
        "sensors are needed to find it" in reason for reason in reasons
    )
    for _ in range(20):
        (pose,) = one.strobed()
    assert pose.valid, pose.reason


def test_a_tool_that_jumps_is_invalid_until_it_is_found_again() -> None:
    one = scene([pointer(strobed=True)])
    for _ in range(40):
        (pose,) = one.strobed()
    assert pose.valid
    (pose,) = one.strobed(off_px=20.0)
    assert pose.status is PoseStatus.INVALID
    assert pose.rotation is None
    for _ in range(8):
        (pose,) = one.strobed()
    assert pose.valid, pose.reason


def test_a_strobed_tool_that_was_just_found_is_confirmed_first() -> None:
    one = scene([pointer(strobed=True)])
    poses = []
    while not poses or not poses[-1].valid:
        (pose,) = one.strobed()
        poses.append(pose)
    found = [pose for pose in poses if "it was just found" in str(pose.reason)]
    assert len(found) == 4
    assert all(pose.status is PoseStatus.MISSING for pose in found)
    assert "1 more exposure must fit" in str(found[-1].reason)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_strobed_through_false_peaks_and_lost_frames_no_wrong_pose_is_ok(seed: int) -> None:
    rng = np.random.default_rng(seed)
    tool = pointer(strobed=True)
    tracker = ToolTracker(CAMERAS, [tool], pixels=PIXELS_OF_ALL)
    time_ms = ok = 0
    for _ in range(700):
        if rng.random() < 0.02:
            time_ms += int(rng.integers(1, 300))
        true = swinging(tool, seed, time_ms)
        marker = time_ms % 4
        # One exposure in a hundred shows another marker than it says.
        shown = (marker + 1) % 4 if rng.random() < 0.01 else marker
        reading = CAMERAS.project(true.markers_mm)[shown] + SIGMA_PX * rng.standard_normal(4)
        reading[rng.random(4) < 0.1] = np.nan
        reading[rng.random(4) < 0.02] += rng.uniform(-50.0, 50.0)
        clutter = rng.uniform(0.0, 2047.0, (4, 2))
        clutter[rng.random((4, 2)) < 0.7] = np.nan
        peaks = np.sort(np.column_stack([reading, clutter]), axis=1)
        (pose,) = tracker.step(
            1_000_000 * time_ms,
            time_ms,
            Measurements.of(
                peaks, np.full(peaks.shape, SIGMA_PX), np.zeros(peaks.shape, dtype=np.int32)
            ),
            marker,
        )
        if pose.valid:
            ok += 1
            assert pose.tip_mm is not None
            assert pose.tip_covariance_mm2 is not None
            off = float(np.linalg.norm(pose.tip_mm - true.tip_world_mm))
            stated = float(np.sqrt(np.trace(pose.tip_covariance_mm2)))
            assert off < 6.0 * stated, (time_ms, off, stated)
        time_ms += 1
    assert ok > 200


def test_look_alikes_are_invalid() -> None:
    twin = replace(pointer(), name="twin")
    tracker = ToolTracker(CAMERAS, [pointer(), twin])
    one = Scene([body(pointer())], tracker)
    poses = one.together()
    assert {pose.status for pose in poses} <= {PoseStatus.INVALID, PoseStatus.MISSING}
    (doubt,) = [pose for pose in poses if pose.status is PoseStatus.INVALID]
    assert 'tool "pointer" and tool "twin"' in str(doubt.reason)


def test_a_limit_of_the_tool_makes_it_high_error() -> None:
    fine = replace(pointer(), max_tip_sd_mm=1e-3)
    one = scene([fine])
    (pose,) = one.together()
    assert pose.status is PoseStatus.HIGH_ERROR
    assert "at most 0.001 mm is allowed" in str(pose.reason)
    assert pose.rotation is not None
    assert not pose.valid


def test_one_marker_alone_soon_tells_the_pose_no_more() -> None:
    one = scene([pointer()])
    for _ in range(20):
        (pose,) = one.together()
    assert pose.valid
    rest = ((1, None), (2, None), (3, None))
    statuses = [one.together(rest)[0].status for _ in range(150)]
    assert statuses[0] is PoseStatus.OK
    assert statuses[-1] in (PoseStatus.HIGH_ERROR, PoseStatus.MISSING)


def test_partial_view_stays_tracked_without_any_point() -> None:
    one = scene([pointer()])
    for _ in range(5):
        one.together()
    hidden = ((0, 0), (0, 1), (1, 1), (1, 2), (2, 2), (2, 3), (3, 3), (3, 0))
    for frame in range(100):
        before = replace(one.bodies[0])
        (pose,) = one.together(hidden, with_points=False)
        # A reading of the full view counts for four exposures.
        low = pose.status is PoseStatus.LOW_RELIABILITY
        assert low if frame >= 4 else pose.valid or low, (frame, pose.reason)
        assert pose.detectable_sigma > 15.0 or not low
        assert 6 <= pose.readings_used <= 8
        assert normalised(pose, before)[0] < 40.0


def test_two_tools_pass_each_other_among_false_peaks() -> None:
    rng = np.random.default_rng(9)
    tools = [pointer(), other()]
    one = scene(tools)
    one.bodies[0].centroid_mm = MIDDLE_MM + np.array([-40.0, 0.0, 30.0])
    one.bodies[1].centroid_mm = MIDDLE_MM + np.array([40.0, 10.0, -30.0])
    one.bodies[0].velocity_mm_s = np.array([400.0, 0.0, 0.0])
    one.bodies[1].velocity_mm_s = np.array([-400.0, 0.0, 0.0])
    worst = 0.0
    ok = 0
    for frame in range(200):
        before = [replace(true) for true in one.bodies]
        clutter = rng.uniform(0.0, 2047.0, (4, 2))
        hidden = ((int(rng.integers(4)), int(rng.integers(4))),)
        poses = one.together(hidden, clutter)
        for pose, true in zip(poses, before, strict=True):
            if frame > 2 and pose.valid:
                ok += 1
                worst = max(worst, normalised(pose, true)[0])
    assert ok > 0.95 * 2 * 197
    assert worst < 60.0


def test_lines_that_merge_are_not_read() -> None:
    # Two tools whose lines cross all the time; a merged peak lies up to 0.5 px, ten standard
    # deviations, off both.
    squares_, merged = [], 0
    for seed in range(2):
        one = scene([pointer(), other()], seed=seed)
        for index, true in enumerate(one.bodies):
            true.centroid_mm = MIDDLE_MM + np.array([30.0 * index - 15.0, 20.0 * index, 10.0])
            true.velocity_mm_s = np.array([60.0, 40.0, 0.0]) * (1 - 2 * index)
            true.angular_velocity_rad_s = np.array([0.5, 0.3, 0.7]) * (1 - 2 * index)
        for _ in range(100):
            before = [replace(true) for true in one.bodies]
            poses = one.together(merging=True)
            for pose, true in zip(poses, before, strict=True):
                if pose.valid:
                    squares_.append(normalised(pose, true)[0])
                    merged += pose.readings_used < 16
    assert merged > 25
    assert len(squares_) > 300
    # One in a hundred thousand of a chi-square of 6 is above 33.
    assert max(squares_) < 45.0


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_lit_together_through_lost_frames_and_clutter_no_wrong_pose_is_ok(seed: int) -> None:
    rng = np.random.default_rng(1000 + seed)
    third = RigidBody("third", np.array([[0.0, 0, 0], [90, 5, 0], [35, 65, 10], [60, -30, 30]]))
    one = scene([pointer(), other(), third], seed=seed)
    rest = [(true.rotation, MIDDLE_MM + rng.uniform(-120.0, 120.0, 3)) for true in one.bodies]
    phases, rates = rng.uniform(0.0, 6.0, (3, 6)), rng.uniform(2.0, 9.0, (3, 6))
    ok = 0
    for _ in range(220):
        if rng.random() < 0.05:
            one.sequence += int(rng.integers(1, 200))
        for true, (rotation, place), phase, rate in zip(
            one.bodies, rest, phases, rates, strict=True
        ):
            swing = np.sin(rate * one.time_ns * 1e-9 + phase)
            true.rotation = rotation_matrix(0.35 * swing[:3]) @ rotation
            true.centroid_mm = place + 40.0 * swing[3:]
        before = [replace(true) for true in one.bodies]
        hidden = tuple((int(rng.integers(4)), int(rng.integers(4))) for _ in range(2))
        poses = one.together(hidden, rng.uniform(0.0, 2047.0, (4, 3)), merging=True)
        for pose, true in zip(poses, before, strict=True):
            if pose.valid:
                ok += 1
                off = float(np.linalg.norm(pose.tip_mm - true.tip_world_mm))
                stated = float(np.sqrt(np.trace(pose.tip_covariance_mm2)))
                assert off < 6.0 * stated, (one.sequence, pose.tool, off, stated)
    assert ok > 600


def test_a_sudden_start_is_followed() -> None:
    one = scene([pointer()])
    for _ in range(30):
        one.together()
    one.bodies[0].velocity_mm_s = np.array([1500.0, 0.0, 0.0])
    one.bodies[0].angular_velocity_rad_s = np.array([0.0, 10.0, 0.0])
    for frame in range(40):
        before = replace(one.bodies[0])
        (pose,) = one.together(with_points=False)
        if frame > 8:
            assert pose.valid, pose.reason
            assert pose.tip_mm == pytest.approx(before.tip_world_mm, abs=1.0)


def test_suspect_peaks_count_for_little_and_refused_ones_for_nothing() -> None:
    one = scene([pointer(strobed=True)])
    for _ in range(40):
        (pose,) = one.strobed()
    peaks = CAMERAS.project(one.bodies[0].markers_mm)[0][:, None]
    sigma = np.full((4, 1), SIGMA_PX)
    certain = []
    for flag in (PeakFlag.NONE, PeakFlag.POOR_FIT, PeakFlag.CLIPPED):
        tracker = ToolTracker(CAMERAS, [pointer(strobed=True)])
        tracker.adopt_state(one.tracker)
        state = one.tracker._tools[0].state
        flags = np.full((4, 1), int(flag), dtype=np.int32)
        (pose,) = tracker.step(one.time_ns, one.sequence, Measurements.of(peaks, sigma, flags), 0)
        assert one.tracker._tools[0].state is state
        certain.append(np.trace(pose.tip_covariance_mm2))
    # In full, for a little, and not at all.
    assert certain[0] < 0.99 * certain[1] < 0.98 * certain[2]


@pytest.mark.parametrize("strobed", [True, False])
def test_an_image_that_is_frozen_is_no_pose(strobed: bool) -> None:
    one = scene([pointer(strobed=strobed)])
    for _ in range(24):
        (pose,) = one.strobed() if strobed else one.together()
    assert pose.valid
    still = one.readings()[0]
    cycle = 4 if strobed else 1
    valid = []
    for frame in range(10 * cycle):
        # Wider or narrower arrays are the same image.
        peaks = np.sort(still[[frame % 4]] if strobed else still, axis=0).T
        peaks = np.hstack([peaks, np.full((4, frame // cycle % 2), np.nan)])
        (pose,) = one._step(peaks, frame % 4 if strobed else None, None)
        valid.append(pose.valid)
    # The first exposure of a marker that is the same to the bit.
    first = cycle
    assert all(valid[:first])
    assert not any(valid[first:])
    assert pose.status is PoseStatus.INVALID
    assert "the image is frozen" in str(pose.reason)
    for _ in range(4 * cycle):
        (pose,) = one.strobed() if strobed else one.together()
    assert pose.valid, pose.reason


def test_the_same_input_gives_the_same_bits() -> None:
    def track() -> list[ToolPose]:
        one = scene([pointer(), other()], seed=3)
        return [pose for _ in range(20) for pose in one.together()]

    for first, second in zip(track(), track(), strict=True):
        assert first.status is second.status
        if first.covariance is not None:
            assert np.array_equal(first.covariance, second.covariance)
            assert np.array_equal(first.tip_mm, second.tip_mm)


def test_what_is_known_can_be_kept_or_forgotten() -> None:
    one = scene([pointer(strobed=True)])
    for _ in range(40):
        (pose,) = one.strobed()
    assert pose.valid
    fresh = ToolTracker(CAMERAS, [other(), pointer(strobed=True)], pixels=PIXELS_OF_ALL)
    fresh.adopt_state(one.tracker)
    one.tracker = fresh
    kept = one.strobed()
    assert [pose.status for pose in kept] == [PoseStatus.UNKNOWN, PoseStatus.OK]
    with pytest.raises(InvalidParameter, match="time goes back"):
        fresh.step(0, 0, Measurements.of(np.full((4, 1), np.nan), np.ones((4, 1))), 0)
    fresh.reset()
    assert one.strobed()[1].status is PoseStatus.MISSING


def test_names_and_shapes_are_checked() -> None:
    with pytest.raises(InvalidParameter, match="two tools"):
        ToolTracker(CAMERAS, [pointer(), pointer()])
    with pytest.raises(InvalidParameter, match="pixels are of 3 sensors"):
        ToolTracker(CameraStack.of(rig()), [pointer()], pixels=(1, 2, 3))
    with pytest.raises(InvalidParameter, match="position_px has the shape"):
        ToolTracker(rig(), [pointer()]).step(
            0,
            0,
            Measurements.of(np.zeros((3, 1)), np.ones((3, 1))),
            None,
        )


def test_prediction_turns_and_moves() -> None:
    one = scene([pointer(strobed=True)])
    for _ in range(40):
        one.strobed()
    state = one.tracker._tools[0].state
    assert state is not None
    state = replace(
        state,
        velocity_mm_s=np.array([10.0, 0.0, -5.0]),
        angular_velocity_rad_s=np.array([0.0, 0.5, 0.0]),
    )
    later = predict(state, state.time_ns + 100_000_000, SETTINGS.motion)
    assert later.centroid_mm - state.centroid_mm == pytest.approx([1.0, 0.0, -0.5])
    turn = rotation_vector(later.rotation @ state.rotation.T)
    assert turn == pytest.approx([0.0, 0.05, 0.0])
    halves = predict(
        predict(state, state.time_ns + 50_000_000, SETTINGS.motion),
        later.time_ns,
        SETTINGS.motion,
    )
    assert np.diag(later.covariance) == pytest.approx(np.diag(halves.covariance), rel=0.02)
    assert (np.diag(later.covariance) > np.diag(state.covariance)).all()
