"""Moving tools through the live path: simulated lines to poses, which agree with the truth."""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final, Literal, cast

import numpy as np
import pytest
from scipy.stats import chi2

from compute.calibration.result import Calibration
from compute.pose.beam_hold import BeamHoldLimits
from compute.pose.rigid_body import RigidBody, ToolPose
from compute.pose.settings import MotionSettings, ToolTrackerSettings
from compute.pose.tool_tracking.tool_tracker import ToolTracker
from compute.tracking.track_batch import TrackState
from compute.tracking.tracker import Tracker
from compute.transform import rotation_vector
from hardware.line_frame import LineFrame
from hardware.simulated.driver import SimulatedDriver
from hardware.simulated.scenes import MovingTool, MovingTools
from hardware.simulated.settings import SimulationSettings
from service.application.initial_content import nominal_calibration
from service.pipeline import device_session, frame_processor
from service.pipeline.active_calibration import ActiveCalibration
from service.pipeline.device_session import DeviceSession, LoadShedding
from service.pipeline.frame_batch import FrameBatch, PoseEntry, TrackingResult
from service.pipeline.frame_processor import FrameProcessor, TakePoses, solve_points
from service.pipeline.pipeline_manager import PipelineManager
from service.pipeline.threads import FrameRing, ReaderThread
from service.pipeline.tracking_config import (
    NO_TRACKING,
    BeamHoldConfig,
    TrackingConfig,
    WatchedStrobedMarkers,
    WatchedTool,
)
from service.pipeline.tracking_stage import FRAME_SKIPPED
from service.protocols.stream.hub import Hub

if TYPE_CHECKING:
    from service.pipeline.beam_hold_registry import BeamHoldRegistry

POINTER = ((0.0, 0.0, 0.0), (80.0, 0.0, 0.0), (0.0, 60.0, 0.0), (20.0, 15.0, 40.0))
PATIENT = ((0.0, 0.0, 0.0), (110.0, 0.0, 0.0), (0.0, 70.0, 0.0), (45.0, 50.0, 30.0))
TIP = (-150.0, 0.0, 0.0)
SCENE = MovingTools(
    (
        MovingTool(POINTER, centre_mm=(-80.0, 0.0, 1480.0)),
        MovingTool(
            PATIENT, centre_mm=(120.0, -40.0, 1560.0), swing_mm=(60.0, 60.0, 60.0), phase=0.3
        ),
    )
)
NAMES = ("pointer", "patient")
STILL = ToolTrackerSettings(
    motion=MotionSettings(acceleration_mm_s2=100.0, angular_acceleration_rad_s2=1.0)
)
"""For tools that hardly move: at 200 Hz each of the eight markers is seen every 40 ms."""
Illumination = Literal["strobed", "simultaneous"]


def simulation(illumination: Illumination, duration_s: float | None) -> SimulationSettings:
    return SimulationSettings(
        scene=SCENE, illumination=illumination, duration_s=duration_s, realtime=False
    )


def tools(illumination: Illumination) -> tuple[RigidBody, ...]:
    return tuple(
        RigidBody(
            name,
            np.array(SCENE.tools[index].markers_mm),
            SCENE.numbers(index) if illumination == "strobed" else None,
            TIP,
        )
        for index, name in enumerate(NAMES)
    )


def exact() -> Calibration:
    """The simulator's own cameras, which err by nothing but the peaks' noise."""
    found = nominal_calibration()
    return replace(found, sensors=tuple(replace(one, sigma_px=1e-3) for one in found.sensors))


def processed(illumination: Illumination, seconds: float) -> list[FrameBatch]:
    driver = SimulatedDriver("sim", simulation(illumination, seconds))
    driver.open()
    processor = FrameProcessor("sim", driver.description, "cpu")
    processor.set_tracking_config(TrackingConfig(True, tools(illumination)))
    processor.set_calibration(ActiveCalibration("nominal", exact()))
    frames = list(driver.frames())
    return [processor.process(frames[first : first + 16]) for first in range(0, len(frames), 16)]


def motion(batch: FrameBatch) -> TrackingResult:
    assert batch.motion is not None
    return batch.motion


def nees(pose: ToolPose, tool: int, time_s: float) -> tuple[float, float]:
    """Return the squared error of the pose over its covariance, and of the tip over its own."""
    rotation, origin = SCENE.pose(tool, time_s)
    assert pose.rotation is not None
    assert pose.translation_mm is not None
    assert pose.covariance is not None
    assert pose.tip_covariance_mm2 is not None
    turn = rotation_vector(pose.rotation @ rotation.T)
    off = np.concatenate([turn, pose.translation_mm - origin])
    tip = pose.tip_mm - (rotation @ np.array(TIP) + origin)
    return (
        float(off @ np.linalg.solve(pose.covariance, off)),
        float(tip @ np.linalg.solve(pose.tip_covariance_mm2, tip)),
    )


@pytest.mark.slow
@pytest.mark.parametrize("illumination", ["strobed", "simultaneous"])
def test_poses_agree_with_the_truth_within_their_covariance(illumination: Illumination):
    squares: list[tuple[float, float]] = []
    good = dict.fromkeys(NAMES, 0)
    frames = 0
    for batch in processed(illumination, 0.2):
        for index, frame in enumerate(batch.frames):
            frames += 1
            poses = motion(batch).poses_of(index)
            assert [pose.tool for pose in poses] == list(NAMES)
            for tool, pose in enumerate(poses):
                assert (pose.sequence, pose.exposure_ns) == (frame.sequence, frame.exposure_host_ns)
                assert (pose.reason is None) == pose.valid
                if pose.valid:
                    good[pose.tool] += 1
                    squares.append(nees(pose, tool, frame.exposure_device_ns * 1e-9))
    # Strobed ones are found when each marker was seen, after two cycles of eight at most.
    assert frames == 200
    assert min(good.values()) >= frames - 2 * SCENE.markers
    from_pose, of_tip = np.array(squares).T
    print(f"{illumination}: tips' normalised error squared {of_tip.mean():.2f} (3 is honest)")
    assert from_pose.mean() <= 6.0 * 1.5
    assert of_tip.mean() <= 3.0 * 1.5
    assert from_pose.max() <= chi2.isf(1e-6, 6)
    assert of_tip.max() <= chi2.isf(1e-6, 3)


def test_markers_that_are_lit_together_are_tracked():
    batch = processed("simultaneous", 0.1)[-1]
    newest = len(batch.frames) - 1
    found = motion(batch)
    own = found.track_owner == newest
    known = own & (found.tracks.state == int(TrackState.CONFIRMED))
    points = SCENE.points(batch.frames[newest].exposure_device_ns * 1e-9)
    apart = np.linalg.norm(found.tracks.position_mm[known][:, None] - points, axis=2)
    assert sorted(apart.argmin(axis=1).tolist()) == list(range(SCENE.markers))
    assert apart.min(axis=1).max() < 1.0


@pytest.mark.parametrize("illumination", ["strobed", "simultaneous"])
def test_poses_are_given_out_before_all_that_they_do_not_need(
    illumination: Illumination, monkeypatch: pytest.MonkeyPatch
):
    driver = SimulatedDriver("sim", simulation(illumination, 0.06))
    driver.open()
    processor = FrameProcessor("sim", driver.description, "cpu")
    processor.set_tracking_config(TrackingConfig(True, tools(illumination)))
    processor.set_calibration(ActiveCalibration("nominal", exact()))
    order: list[str] = []

    def noting(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any) -> Any:
            order.append(name)
            return function(*args)

        return call

    monkeypatch.setattr(frame_processor, "solve_points", noting("points", solve_points))
    monkeypatch.setattr(Tracker, "step", noting("tracks", Tracker.step))
    monkeypatch.setattr(ToolTracker, "step", noting("tools", ToolTracker.step))
    early: list[FrameBatch] = []

    def take_poses(batch: FrameBatch) -> None:
        order.append("given out")
        early.append(batch)

    frames = list(driver.frames())
    for first in range(0, len(frames), 2):
        order.clear()
        batch = processor.process(frames[first : first + 2], take_poses=take_poses)
        if illumination == "strobed":
            assert order == ["tools", "tools", "given out", "points", "tracks", "tracks"]
        else:
            assert order == ["points", "tools", "tools", "given out", "tracks", "tracks"]
        assert motion(early[-1]).poses == motion(batch).poses
        assert early[-1].frames == batch.frames
    assert any(pose.valid for pose in motion(early[-1]).poses)


def test_no_poses_are_given_out_where_there_are_no_tools():
    driver = SimulatedDriver("sim", simulation("strobed", 0.01))
    driver.open()
    processor = FrameProcessor("sim", driver.description, "cpu")
    processor.set_calibration(ActiveCalibration("nominal", exact()))
    for tracked in (NO_TRACKING, TrackingConfig(True)):
        processor.set_tracking_config(tracked)
        processor.process(list(driver.frames()), take_poses=lambda _: pytest.fail("no tools"))


def test_a_tool_goes_on_when_another_is_added():
    driver = SimulatedDriver("sim", simulation("strobed", 0.06))
    driver.open()
    processor = FrameProcessor("sim", driver.description, "cpu")
    first, second = tools("strobed")
    processor.set_tracking_config(TrackingConfig(False, (first,)))
    processor.set_calibration(ActiveCalibration("nominal", exact()))
    frames = list(driver.frames())
    before = motion(processor.process(frames[:40])).poses[-1]
    assert before.valid
    processor.set_tracking_config(TrackingConfig(False, (second, first)))
    # Found anew it would need each of its markers first.
    other, after = motion(processor.process(frames[40:41])).poses
    assert (other.tool, after.tool) == (second.name, first.name)
    assert after.valid
    assert not other.valid
    assert motion(processor.process(frames[41:])).poses[-2].valid


def test_a_device_that_follows_nothing_makes_no_motion():
    driver = SimulatedDriver("sim", simulation("strobed", 0.02))
    driver.open()
    processor = FrameProcessor("sim", driver.description, "cpu")
    processor.set_calibration(ActiveCalibration("nominal", exact()))
    frames = list(driver.frames())
    assert processor.process(frames[:10]).motion is None
    processor.set_tracking_config(TrackingConfig(True))
    assert processor.process(frames[10:]).motion is not None
    processor.set_tracking_config(NO_TRACKING)
    assert processor.process(frames[:1]).motion is None


@pytest.fixture
def live() -> Iterator[PipelineManager]:
    manager = PipelineManager(Hub(), "cpu")
    yield manager
    manager.close()


def wait_for(condition: Callable[[], object], seconds: float = 240.0) -> None:
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not come true"
        time.sleep(0.005)


def entry(live: PipelineManager) -> PoseEntry | None:
    return live.poses.newest().get("sim")


def test_the_board_has_the_poses_of_a_running_device_and_of_no_other(live: PipelineManager):
    live.set_tracking_config("sim", TrackingConfig(False, tools("strobed"), tool_tracker=STILL))
    # In real time, and slowly: of a device that the server does not keep up with there are none.
    settings = replace(
        simulation("strobed", None),
        scene=replace(SCENE, moving=False),
        realtime=True,
        frame_rate_hz=200.0,
    )
    driver = SimulatedDriver("sim", settings)
    live.start_device("sim", driver, ActiveCalibration("nominal", exact()))

    def valid() -> bool:
        there = entry(live)
        return there is not None and all(pose.valid for pose in there.poses.values())

    wait_for(valid)
    there = entry(live)
    assert there is not None
    assert list(there.poses) == list(NAMES)
    assert (there.calibration_id, there.frame_rate_hz) == ("nominal", 200.0)
    assert {pose.sequence for pose in there.poses.values()} == {there.sequence}
    counts = live.pose_counts()["sim"]
    assert counts["pointer"].frames
    assert counts["pointer"].newest_ns is not None
    # Without its reference, while it runs; with neither there is nothing to put up.
    live.set_tracking_config("sim", TrackingConfig(False, tools("strobed")[:1], tool_tracker=STILL))
    wait_for(lambda: (now := entry(live)) is not None and list(now.poses) == ["pointer"])
    assert list(live.pose_counts()["sim"]) == ["pointer"]
    live.set_tracking_config("sim", NO_TRACKING)
    assert entry(live) is None
    live.set_tracking_config("sim", TrackingConfig(False, tools("strobed"), tool_tracker=STILL))
    wait_for(valid)
    live.set_calibration("sim", ActiveCalibration())
    wait_for(lambda: (now := entry(live)) is not None and now.calibration_id is None)
    without = entry(live)
    assert without is not None
    assert without.poses["pointer"].reason == "the device has no active calibration"
    live.stop_device("sim")
    assert entry(live) is None


def test_a_recording_that_ends_leaves_no_pose_behind(live: PipelineManager):
    live.set_tracking_config("sim", TrackingConfig(False, tools("strobed")))
    driver = SimulatedDriver("sim", simulation("strobed", 0.05))
    live.start_device("sim", driver, ActiveCalibration("nominal", exact()))
    wait_for(lambda: live.status("sim").frames_processed == 50)
    wait_for(lambda: entry(live) is None)
    assert sum(live.pose_counts()["sim"]["pointer"].frames.values()) > 0


class Costs(LoadShedding):
    """Every frame costs so much to follow, whatever it takes here."""

    tracking_s = 0.0

    def count(self, followed: int, tracking_s: float, rest_s: float) -> None:
        super().count(followed, followed * self.tracking_s, 0.0)


class Bench:
    """A device at 1 kHz whose frames come as they are asked for, and what is made of them."""

    wants_pixels: Final = False

    def __init__(self, seconds: float) -> None:
        driver = SimulatedDriver("sim", simulation("strobed", seconds))
        driver.open()
        processor = FrameProcessor("sim", driver.description, "cpu")
        processor.set_tracking_config(TrackingConfig(True, tools("strobed")))
        processor.set_calibration(ActiveCalibration("nominal", exact()))
        self.ring = FrameRing(1000)
        self.device_session = DeviceSession("sim", driver.description, processor, self.ring, Hub())
        self.reader = ReaderThread("sim", driver, self.ring, lambda: None, lambda: None)
        self.device_session.reader = self.reader
        self.device_session.load_shedding = self.costs = Costs(driver.description.frame_rate_hz)
        self.device_session.attach(self)
        self.frames = list(driver.frames())
        self.taken: list[FrameBatch] = []
        self.shown: list[PoseEntry] = []

    def prepare(self, found: ActiveCalibration) -> None: ...

    def offer(self, batch: FrameBatch) -> None:
        self.taken.append(batch)

    def work(self, first: int, last: int) -> list[FrameBatch]:
        """Let frames wait, and return the batches in which they are worked on."""
        self.taken.clear()
        for frame in self.frames[first:last]:
            self.ring.put(frame)
        while self.device_session.work():
            self.shown += self.device_session.poses.newest().values()
        worked = [frame.sequence for batch in self.taken for frame in batch.frames]
        assert worked == list(range(first, last))  # each once, and in order
        for batch in self.taken:
            assert len(batch.points) == len(batch.frames)  # followed or not
        return list(self.taken)

    @property
    def not_followed(self) -> int:
        return self.device_session.status().frames_not_tracked


class HoldTimes:
    """Stands for the registry of beam holds: notes what was known when the holds were stepped."""

    def __init__(self) -> None:
        self.points: list[int] = []

    def take(self, batch: FrameBatch) -> tuple[tuple[()], ...]:
        self.points.append(len(batch.points))
        return ((),) * len(batch.frames)


def hold(spec: WatchedTool | WatchedStrobedMarkers) -> BeamHoldConfig:
    return BeamHoldConfig("hold", "sim", "key", spec, BeamHoldLimits(shift_mm=1.0))


@pytest.mark.parametrize("others", [(), (hold(WatchedStrobedMarkers((0, 1, 2), 3)),)])
def test_holds_of_tools_alone_do_not_wait_for_points(others: tuple[BeamHoldConfig, ...]):
    bench, times = Bench(0.02), HoldTimes()
    bench.device_session.holds = cast("BeamHoldRegistry", times)
    holds = (hold(WatchedTool("pointer")), *others)
    bench.device_session.set_tracking_config(TrackingConfig(True, tools("strobed"), holds=holds))
    batches = bench.work(0, 20)
    assert all(batch.holds == ((),) * len(batch.frames) for batch in batches)
    # Once a batch, and with what it needs: the points where a hold watches markers.
    assert times.points == [len(batch.frames) if others else 0 for batch in batches]


def passed_over(batch: FrameBatch) -> list[bool]:
    """Return of each frame of a batch whether it was; then it has no tracks either."""
    poses = [motion(batch).poses_of(index)[0] for index in range(len(batch.frames))]
    over = [pose.reason == FRAME_SKIPPED for pose in poses]
    assert not any(one and pose.valid for one, pose in zip(over, poses, strict=True))
    assert not any(over[frame] for frame in motion(batch).track_owner.tolist())
    return over


def test_of_frames_that_waited_too_long_there_are_no_poses():
    """The compute thread was away for 0.2 s at 1 kHz, however many frames it then takes at once."""
    bench = Bench(0.6)
    batches = [one for first in range(0, 60, 20) for one in bench.work(first, first + 20)]
    assert motion(batches[-1]).poses[-1].valid  # behind by less than it may be
    assert bench.not_followed == 0
    late = [passed_over(batch) for batch in bench.work(60, 260)]
    assert all(late[0])
    told = [over for batch in late for over in batch]
    assert sorted(told, reverse=True) == told  # from the first to where it has caught up
    followed = told.count(False)
    assert followed <= 21  # of 0.02 s
    assert bench.not_followed == 200 - followed
    # A few at a time it keeps up: it finds them again, and counts no more.
    batches = [one for first in range(260, 400, 10) for one in bench.work(first, first + 10)]
    assert motion(batches[-1]).poses[-1].valid
    assert bench.not_followed == 200 - followed
    bench.reader.lossless = True  # a recording that is replayed as fast as it can be
    assert not any(over for batch in bench.work(400, 600) for over in passed_over(batch))


@pytest.mark.slow
def test_who_is_too_slow_for_all_frames_follows_some_and_keeps_the_tools(
    monkeypatch: pytest.MonkeyPatch,
):
    monkeypatch.setattr(
        device_session, "BATCH_SECONDS", 1e6
    )  # batches as they would be, however slow
    bench = Bench(0.5)
    bench.costs.tracking_s = 1.5e-3
    bench.work(0, 40)  # more than may wait
    bench.shown.clear()
    over = [passed_over(one) for first in range(40, 500, 4) for one in bench.work(first, first + 4)]
    assert not any(all(batch) or batch[-1] for batch in over)  # the newest is followed
    share = [one for batch in over for one in batch].count(False) / 460
    # Two of four fit into a slice; here no time goes by until the next ones are looked at.
    assert 0.4 <= share <= 0.9
    assert bench.not_followed >= round(460 * (1.0 - share))
    # Nothing that was passed over is put up, and the rest is enough to know where all is.
    late = [entry for entry in bench.shown if entry.sequence > 200]
    assert late
    assert all(pose.valid for entry in late for pose in entry.poses.values())


class Clock:
    """The session's clock: goes on by what frames are said to cost."""

    def __init__(self) -> None:
        self.now_s = 0.0

    def monotonic(self) -> float:
        return self.now_s

    def time_ns(self) -> int:
        return round(1e9 * self.now_s)


class Costly(FrameProcessor):
    """Frames cost so much each, to follow and for the rest."""

    clock: Clock
    follow_s = rest_s = 0.0

    def process(
        self,
        frames: Sequence[LineFrame],
        *,
        track: Sequence[bool] | None = None,
        take_poses: TakePoses | None = None,
    ) -> FrameBatch:
        spent_s = self.follow_s * sum((True,) * len(frames) if track is None else track)
        self.clock.now_s += spent_s + self.rest_s * len(frames)
        batch = super().process(frames, track=track, take_poses=take_poses)
        self.tracking_s = spent_s
        return batch


@pytest.mark.parametrize(
    ("waits", "sheds", "follow_s", "most"),
    [
        (20, False, 3.5e-3, 5),  # the other devices wait for all that frames cost, 4 ms each
        (60, True, 3.5e-3, 40),  # for 0.5 ms each, as one of them is followed
        (60, True, 30e-3, 40),  # longer than a batch may take, whatever its length
    ],
)
def test_batches_are_as_long_as_other_devices_can_wait(
    waits: int, sheds: bool, follow_s: float, most: int, monkeypatch: pytest.MonkeyPatch
):
    bench = Bench(0.4)
    clock = Clock()
    monkeypatch.setattr(device_session, "time", clock)
    description = bench.device_session.description
    slow = Costly("sim", description, "cpu")
    slow.set_tracking_config(TrackingConfig(True, tools("strobed")))
    slow.set_calibration(ActiveCalibration("nominal", exact()))
    slow.clock, slow.follow_s, slow.rest_s = clock, follow_s, 0.5e-3
    bench.device_session.processor = slow
    bench.device_session.load_shedding = load_shedding = LoadShedding(description.frame_rate_hz)
    bench.work(0, waits)  # what frames cost is not known yet
    lengths = [
        len(batch.frames)
        for first in range(waits, 5 * waits, waits)
        for batch in bench.work(first, first + waits)
    ]
    assert load_shedding.sheds == sheds
    assert most // 2 < max(lengths) <= most  # the last ones may be left for the next batch
