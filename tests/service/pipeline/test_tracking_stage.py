"""Tracks and poses of a batch: who is called with what, and what happens when they fail."""

from collections.abc import Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from compute.measurement.flag_policy import STANDARD_POLICY
from compute.measurement.measurements import Measurements
from compute.pose.rigid_body import PoseStatus, RigidBody
from compute.reconstruction.point_batch import PointBatch
from compute.reconstruction.solver import PointSolver
from hardware.line_frame import LineFrame
from service.application.initial_content import nominal_calibration
from service.pipeline.active_calibration import PreparedCalibration
from service.pipeline.frame_batch import TrackingResult
from service.pipeline.tracking_config import NO_TRACKING, TrackingConfig
from service.pipeline.tracking_stage import FRAME_SKIPPED, TrackingStage
from tests.service.pipeline.fake_trackers import Making, some_tracks

SENSORS = 4


def tool(name: str) -> RigidBody:
    return RigidBody(name, np.array([[0.0, 0.0, 0.0], [80.0, 0.0, 0.0], [0.0, 60.0, 0.0]]))


@pytest.fixture(scope="module")
def active() -> PreparedCalibration:
    calibration = nominal_calibration()
    solver = PointSolver(calibration.models, None, None, "cpu", threads=1)
    return PreparedCalibration("nominal", calibration, None, solver)


def frames(
    count: int, first: int = 0, marker: int | None = None, start_ns: int = 0
) -> tuple[LineFrame, ...]:
    lines = np.zeros((SENSORS, 8), np.uint16)
    return tuple(
        LineFrame("sim", n, start_ns + n * 1000, 10**18 + n * 1000, marker, lines)
        for n in range(first, first + count)
    )


def peaks(count: int, visible: int = 2) -> Measurements:
    position = np.full((count, SENSORS, 3), np.nan)
    position[:, :, :visible] = 500.0
    sigma, flags = np.full_like(position, 0.1), np.zeros(position.shape, np.int32)
    return Measurements.weigh(position, sigma, flags, np.ones_like(position), STANDARD_POLICY)


def find(
    finding: TrackingStage,
    given: Sequence[LineFrame],
    measurements: Measurements | None,
    points: PointBatch,
    owner: NDArray[np.intp],
    track: Sequence[bool] | None = None,
) -> TrackingResult:
    poses = finding.find_poses(given, measurements, points, owner, track)
    return TrackingResult.of(finding.find_tracks(given, measurements, track), poses)


def found(finding: TrackingStage, given: tuple[LineFrame, ...], visible: int = 2) -> TrackingResult:
    nothing = np.empty(0, np.intp)
    return find(finding, given, peaks(len(given), visible), PointBatch.empty(SENSORS), nothing)


def following(making: Making, active: PreparedCalibration | None, *names: str) -> TrackingStage:
    finding = TrackingStage("sim", SENSORS, reads=True, make=making)
    finding.set_tracking_config(TrackingConfig(True, tuple(map(tool, names))))
    finding.set_calibration(active)
    return finding


def statuses(motion: TrackingResult, frame: int) -> dict[str, tuple[PoseStatus, str | None]]:
    return {pose.tool: (pose.status, pose.reason) for pose in motion.poses_of(frame)}


def test_frames_go_to_the_trackers_one_by_one(active: PreparedCalibration):
    making = Making()
    finding = following(making, active, "a", "b")
    motion = found(finding, frames(3))
    assert making.made_markers[0].steps == [(0, None), (1000, None), (2000, None)]
    assert making.made_tools[0].steps == [(n * 1000, n, None, 0) for n in range(3)]
    assert motion.track_owner.tolist() == [0, 0, 1, 1, 2, 2]
    assert motion.tracks.identity.tolist() == [1, 2] * 3
    assert motion.pose_owner.tolist() == [0, 0, 1, 1, 2, 2]
    assert [pose.tool for pose in motion.poses] == ["a", "b"] * 3
    # On the host's clock, whatever the trackers count in.
    assert [pose.exposure_ns for pose in motion.poses_of(2)] == [10**18 + 2000] * 2
    found(finding, frames(2, 3, marker=7))
    assert making.made_markers[0].steps[3:] == [(3000, 7), (4000, 7)]
    assert making.made_tools[0].steps[3:] == [(3000, 3, 7, None), (4000, 4, 7, None)]


def test_frames_that_are_not_followed_show_nothing_and_reach_no_tracker(
    active: PreparedCalibration,
):
    making = Making()
    finding = following(making, active, "a", "b")
    nothing = np.empty(0, np.intp)
    given = peaks(4), PointBatch.empty(SENSORS), nothing
    motion = find(finding, frames(4), *given, track=(True, False, False, True))
    assert [step[0] for step in making.made_markers[0].steps] == [0, 3000]
    assert [step[1] for step in making.made_tools[0].steps] == [0, 3]
    assert motion.track_owner.tolist() == [0, 0, 3, 3]
    for frame, (status, reason) in enumerate(
        [(PoseStatus.OK, None), *[(PoseStatus.MISSING, FRAME_SKIPPED)] * 2, (PoseStatus.OK, None)]
    ):
        assert statuses(motion, frame) == {"a": (status, reason), "b": (status, reason)}
        assert [pose.sequence for pose in motion.poses_of(frame)] == [frame] * 2


def test_a_clock_that_goes_back_in_a_frame_that_is_not_followed_is_noticed(
    active: PreparedCalibration,
):
    making = Making()
    finding = following(making, active, "a")
    given = peaks(2), PointBatch.empty(SENSORS), np.empty(0, np.intp)
    find(finding, frames(2, start_ns=10**6), *given)
    find(finding, frames(2), *given, track=(False, False))
    find(finding, frames(2, start_ns=10**6), *given)
    assert making.made_tools[0].resets == making.made_markers[0].resets == 1


def test_a_frame_without_tracks_is_none_of_another(active: PreparedCalibration):
    motion = found(following(Making(), active), frames(2), visible=0)
    assert len(motion.tracks) == 0
    assert motion.tracks.peaks.shape == (0, SENSORS)
    assert motion.poses == ()
    joined = TrackingResult.of(
        [some_tracks(0), some_tracks(2), some_tracks(0), some_tracks(1)], [[]] * 4
    )
    assert joined.track_owner.tolist() == [1, 1, 3]


def test_without_a_calibration_poses_say_so(active: PreparedCalibration):
    making = Making()
    finding = following(making, None, "a")
    nothing = PointBatch.empty(SENSORS), np.empty(0, np.intp)
    motion = find(finding, frames(2), None, *nothing)
    assert statuses(motion, 1) == {
        "a": (PoseStatus.UNKNOWN, "the device has no active calibration")
    }
    assert making.made_tools == making.made_markers == []
    unread = TrackingStage("sim", SENSORS, reads=False, make=making)
    unread.set_tracking_config(TrackingConfig(True, (tool("a"),)))
    unread.set_calibration(active)
    reason = statuses(find(unread, frames(1), None, *nothing), 0)["a"][1]
    assert reason is not None
    assert "read the lines" in reason
    finding.set_calibration(active)
    assert statuses(found(finding, frames(1)), 0) == {"a": (PoseStatus.OK, None)}


def test_a_tool_that_cannot_be_tracked_leaves_the_others_alone(
    active: PreparedCalibration, caplog: pytest.LogCaptureFixture
):
    finding = following(Making(), active, "a", "wrong", "z")
    for first in (0, 1):
        assert statuses(found(finding, frames(1, first)), 0) == {
            "a": (PoseStatus.OK, None),
            "wrong": (
                PoseStatus.INVALID,
                "the tool cannot be tracked: its markers are on a line",
            ),
            "z": (PoseStatus.OK, None),
        }
    assert "its tool wrong cannot be tracked" in caplog.text


def test_a_tool_whose_tracking_fails_is_found_out(
    active: PreparedCalibration, caplog: pytest.LogCaptureFixture
):
    finding = following(Making(), active, "a", "late", "z")
    motion = found(finding, frames(8))
    ok = (PoseStatus.OK, None)
    failed = (PoseStatus.INVALID, "its tracking failed: ZeroDivisionError")
    # Together they fail in the third frame, and the one by itself in its own third.
    expected = [{"late": ok, "a": ok, "z": ok}] * 2 + [dict.fromkeys(("a", "late", "z"), failed)]
    expected += [{"late": ok, "a": ok, "z": ok}] * 2 + [{"late": failed, "a": ok, "z": ok}] * 3
    assert [statuses(motion, frame) for frame in range(8)] == expected
    assert [pose.tool for pose in motion.poses_of(7)] == ["a", "late", "z"]
    assert caplog.text.count("ZeroDivisionError: of the tools") == 2  # not for every frame


def test_a_tool_whose_tracking_failed_begins_anew_and_more_rarely_each_time(
    active: PreparedCalibration, caplog: pytest.LogCaptureFixture
):
    finding = following(Making(), active, "late")
    tenth_s = 100_000_000
    valid = [
        statuses(found(finding, frames(1, n, start_ns=n * tenth_s)), 0)["late"][0] is PoseStatus.OK
        for n in range(60)
    ]
    # Every time it holds for two frames and fails in the third; then it waits 0.5 s, 1 s, 2 s.
    assert [n for n, one in enumerate(valid) if one] == [0, 1, 7, 8, 19, 20, 41, 42]
    assert caplog.text.count("tracking of late failed") == 4
    # The device was started again: its clock is an earlier one.
    motion = found(finding, frames(1, 60))
    assert statuses(motion, 0) == {"late": (PoseStatus.OK, None)}


def test_other_tools_are_followed_from_the_next_batch_on(active: PreparedCalibration):
    making = Making()
    finding = following(making, active, "a")
    found(finding, frames(1))
    finding.set_tracking_config(TrackingConfig(True, (tool("a"), tool("b"))))
    assert set(statuses(found(finding, frames(1, 1)), 0)) == {"a", "b"}
    assert len(making.made_markers) == 1  # the tracks go on
    assert making.before == [None, making.made_tools[0]]  # and so do the tools
    finding.set_tracking_config(TrackingConfig(False, (tool("b"),)))
    motion = found(finding, frames(1, 2))
    assert (set(statuses(motion, 0)), len(motion.tracks)) == ({"b"}, 0)
    finding.set_tracking_config(NO_TRACKING)
    motion = found(finding, frames(1, 3))
    assert (len(motion.poses), len(motion.tracks)) == (0, 0)


def test_numbers_of_tracks_are_not_used_again(active: PreparedCalibration):
    making = Making(fails_at=2)
    finding = following(making, active)
    motion = found(finding, frames(4))
    # The third frame fails and has no tracks; the fourth is a new tracker's.
    assert motion.tracks.identity.tolist() == [1, 2, 1, 2, 3, 4]
    assert motion.track_owner.tolist() == [0, 0, 1, 1, 3, 3]
    finding.set_calibration(active)
    assert found(finding, frames(1, 4)).tracks.identity.tolist() == [5, 6]


def test_tracking_of_markers_that_fails_again_and_again_ends(
    active: PreparedCalibration, caplog: pytest.LogCaptureFixture
):
    making = Making(fails_at=0)
    finding = following(making, active, "a")
    motion = found(finding, frames(10))
    assert len(motion.tracks) == 0
    assert len(making.made_markers) == 1 + TrackingStage.MAX_RESTARTS
    assert "has ended" in caplog.text
    assert statuses(motion, 9) == {"a": (PoseStatus.OK, None)}


def test_a_clock_that_goes_back_begins_anew(active: PreparedCalibration):
    making = Making()
    finding = following(making, active, "a")
    found(finding, frames(2, start_ns=10**9))
    assert (making.made_markers[0].resets, making.made_tools[0].resets) == (0, 0)
    found(finding, frames(2))
    assert (making.made_markers[0].resets, making.made_tools[0].resets) == (1, 1)
