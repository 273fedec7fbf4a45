"""How long a strobe takes is learned, and tools whose turn comes seldom are waited for."""

from copy import deepcopy
from dataclasses import replace

import numpy as np

from compute.measurement.measurements import Measurements
from compute.pose.rigid_body import PoseStatus, ToolPose
from compute.pose.settings import ToolTrackerSettings
from compute.pose.tool_tracking.exposure_history import StrobeCycle
from compute.pose.tool_tracking.tool_tracker import ToolTracker
from tests.compute.pose.scene import CAMERAS, SIGMA_PX, body, pointer

MS = 1_000_000


def test_the_shortest_of_the_last_times_counts() -> None:
    cycle = StrobeCycle()
    assert cycle.duration_ns((0, 1)) == 0
    for turn in range(4):
        cycle.add_exposure(0, turn * 40 * MS)
        cycle.add_exposure(None, turn * 40 * MS + 1)
    assert cycle.duration_ns((0, 1)) == 40 * MS
    assert cycle.duration_ns((5,)) == cycle.duration_ns(None) == 0
    # Frames were lost, once and for long.
    cycle.add_exposure(0, 200 * MS)
    cycle.add_exposure(0, 9000 * MS)
    assert cycle.duration_ns((0,)) == 40 * MS
    # A slower strobe is believed when nothing else was seen three times.
    for turn in range(3):
        cycle.add_exposure(0, 9000 * MS + (turn + 1) * 70 * MS)
    assert cycle.duration_ns((0,)) == 70 * MS


def test_a_copy_learns_by_itself() -> None:
    cycle = StrobeCycle()
    cycle.add_exposure(0, 0)
    cycle.add_exposure(0, 10 * MS)
    other = deepcopy(cycle)
    assert other.duration_ns((0,)) == 10 * MS
    other.add_exposure(0, 13 * MS)
    assert (other.duration_ns((0,)), cycle.duration_ns((0,))) == (3 * MS, 10 * MS)


def seen_seldom(hidden_from: int, turns: int) -> list[tuple[int, ToolPose]]:
    """Poses of a tool at rest whose four markers are lit in 160 slots, 1 ms each."""
    tool = replace(pointer(strobed=True), max_tip_sd_mm=5.0)
    tracker = ToolTracker(CAMERAS, [tool])
    true = body(tool)
    rng = np.random.default_rng(2)
    exact = CAMERAS.project(true.markers_mm)
    found = []
    for frame in range(160 * turns):
        slot = frame % 160
        peaks = np.full((4, 1), np.nan)
        if slot < 4 and frame < hidden_from:
            peaks[:, 0] = exact[slot] + SIGMA_PX * rng.standard_normal(4)
        (pose,) = tracker.step(
            frame * MS, frame, Measurements.of(peaks, np.full((4, 1), SIGMA_PX)), slot
        )
        if pose.rotation is not None:
            assert pose.tip_mm is not None
            assert pose.tip_covariance_mm2 is not None
            off = np.linalg.norm(pose.tip_mm - true.tip_world_mm)
            assert off < 5.0 * np.sqrt(np.trace(pose.tip_covariance_mm2))
        found.append((slot, pose))
    return found


def test_a_tool_whose_turn_comes_seldom_is_not_lost() -> None:
    poses = seen_seldom(10**6, 7)[3 * 160 :]
    after = [pose for slot, pose in poses if slot == 3]
    assert all(pose.rotation is not None for pose in after)
    assert after[-1].valid, after[-1].reason
    # Between two turns no pose rests on prediction for longer than it may.
    most = ToolTrackerSettings().coast_s
    stale = [pose for slot, pose in poses if slot - 3 > 1e3 * most]
    assert all(pose.status is PoseStatus.MISSING for pose in stale)
    assert "its markers' turn to be lit comes every 160 ms" in str(stale[-1].reason)


def test_a_tool_that_is_gone_is_given_up_after_its_turn() -> None:
    poses = seen_seldom(4 * 160, 7)[5 * 160 :]
    assert all(pose.status is PoseStatus.MISSING for _, pose in poses)
    assert "0 of 4 markers were seen in the last" in str(poses[-1][1].reason)
