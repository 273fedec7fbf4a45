"""Strobed tools that are looked for in vain are looked for more and more rarely."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from compute.measurement.measurement_model import MeasurementModel
from compute.measurement.measurements import Measurements
from compute.pose.acquisition.acquisition_strobed import (
    MAX_DELAY_FRACTION,
    MAX_PAUSE_NS,
    AcquisitionBackoff,
    MarkerExposure,
    StrobedAcquisition,
    acquire_strobed,
)
from compute.pose.rigid_body import CentredMarkers, PoseStatus
from compute.pose.tool_tracking import tool_search
from compute.pose.tool_tracking.tool_tracker import ToolTracker
from tests.compute.pose.scene import CAMERAS, PIXELS_OF_ALL, SIGMA_PX, Scene, body, pointer

Array = NDArray[np.float64]
TURN = 4


def searched(rate_hz: float, seconds: float, readings: int = 32, turn: int = TURN) -> list[int]:
    """When it was looked for, in vain every time [exposures]."""
    pause, found = AcquisitionBackoff(), []
    for exposure in range(round(seconds * rate_hz)):
        time_ns = round(1e9 * exposure / rate_hz)
        pause.count_exposure()
        if pause.due(time_ns, readings):
            found.append(exposure)
            pause.record_failure(time_ns, readings, turn)
    return found


@pytest.mark.parametrize("rate_hz", [60.0, 200.0, 1000.0, 4000.0])
def test_pauses_are_a_share_of_the_time_in_vain_up_to_the_longest(rate_hz: float) -> None:
    found = searched(rate_hz, 6.0)
    gaps = [after - before for before, after in pairwise(found)]
    longest = max(TURN, np.ceil(1e-9 * MAX_PAUSE_NS * rate_hz))
    for before, gap in zip(found, gaps, strict=False):
        share = MAX_DELAY_FRACTION * before  # the first was at the first exposure
        assert min(max(TURN, share), longest) <= gap <= min(max(TURN, share + 1), longest)
    assert gaps[0] == TURN
    assert gaps[-1] == longest


def test_something_new_is_looked_at_at_once() -> None:
    pause = AcquisitionBackoff()
    for exposure in range(1000):
        pause.count_exposure()
        if pause.due(exposure * 1_000_000, 16):
            pause.record_failure(exposure * 1_000_000, 16, TURN)
    now_ns = 1000 * 1_000_000
    assert pause.is_waiting
    assert not pause.due(now_ns, 16)
    assert not pause.due(now_ns, 12)
    assert pause.due(now_ns, 17)  # a sensor more sees it
    pause.record_failure(now_ns, 17, TURN)
    due = []
    for exposure in range(TURN):
        due.append(pause.due(now_ns + exposure, 17))
        pause.count_exposure()
    assert due == [False] * TURN
    assert pause.due(now_ns + TURN, 17)
    pause.reset()
    assert not pause.is_waiting
    assert pause.due(now_ns, 1)


class Counted:
    """Counts the searches of a tracker."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.number = 0
        monkeypatch.setattr(tool_search, "acquire_strobed", self)

    def __call__(self, *given: object) -> StrobedAcquisition:
        self.number += 1
        return acquire_strobed(*given)  # type: ignore[arg-type]


def lost() -> Scene:
    tool = pointer(strobed=True)
    return Scene([body(tool)], ToolTracker(CAMERAS, [tool], pixels=PIXELS_OF_ALL))


OFF_PX = np.array([90.0, -60.0, 40.0, -80.0])
"""By which the sensors of another calibration read."""


def max_searches(seconds: float) -> int:
    """Of a time at 1 kHz: those of the pauses, and some while there are more and more readings."""
    return len(searched(1000.0, seconds)) + 2 * TURN


def off(scene: Scene) -> str | None:
    """A frame whose readings never fit."""
    scene.strobed(off_px=OFF_PX)  # type: ignore[arg-type]
    tool = scene.tracker._tools[0]
    assert tool.state is None
    assert tool.status is PoseStatus.INVALID or scene.sequence <= 4
    return tool.reason


@pytest.mark.slow
def test_readings_that_never_fit_cost_few_searches_and_the_reason_stays(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    counted, scene = Counted(monkeypatch), lost()
    reasons = [off(scene) for _ in range(600)]
    assert 5 <= counted.number <= max_searches(0.6)
    assert all("do not fit the tool" in str(reason) for reason in reasons[8:])
    # Its readings are right from now on.
    turns = range(round(1e-6 * MAX_PAUSE_NS) + 4 * TURN)
    assert any(scene.strobed()[0].valid for _ in turns)


@pytest.mark.slow
def test_a_tool_that_comes_back_is_looked_for_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = lost()
    counted = Counted(monkeypatch)
    for _ in range(600):
        off(scene)
    for _ in range(3 * TURN):
        scene.strobed(blind=True)
    before = counted.number
    poses = [scene.strobed()[0] for _ in range(5 * TURN)]
    # From two exposures of each marker, of which the hidden ones tell nothing, and confirmed.
    assert poses[-1].valid
    assert any(pose.valid for pose in poses[: 3 * TURN])
    assert counted.number - before <= 4


def test_a_tool_that_is_found_where_it_is_not_is_not_looked_for_all_the_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """What is found and not confirmed is as much in vain."""
    elsewhere = lost()
    while elsewhere.tracker._tools[0].state is None:
        elsewhere.strobed()
    state = elsewhere.tracker._tools[0].state
    assert state is not None
    number = 0

    def wrong(
        _: MeasurementModel, __: CentredMarkers, exposures: Sequence[MarkerExposure], *___: object
    ) -> StrobedAcquisition:
        nonlocal number
        number += 1
        now = replace(state, time_ns=exposures[-1].time_ns)
        return StrobedAcquisition(now, None, False, 20.0, 32, searched=True)

    monkeypatch.setattr(tool_search, "acquire_strobed", wrong)
    scene = lost()
    for centred in range(1200):
        if centred == 600:
            before = number
        (pose,) = scene.strobed(off_px=300.0)
        assert not pose.valid
    assert before >= 5
    # From all exposures that there may be, since 0.3 s before: it doubled and tripled meanwhile.
    assert 1 <= number - before <= 2 + np.log(3.0) / np.log(1.0 + MAX_DELAY_FRACTION)


@pytest.mark.slow
def test_a_tool_that_was_confirmed_is_looked_for_at_once_when_it_is_lost(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    scene = lost()
    for _ in range(600):
        off(scene)
    while not scene.strobed()[0].valid:
        assert scene.sequence < 900
    counted = Counted(monkeypatch)
    scene.bodies[0].centroid_mm = scene.bodies[0].centroid_mm + np.array([40.0, 0.0, 0.0])
    poses = [scene.strobed()[0] for _ in range(5 * TURN)]
    assert poses[-1].valid
    assert 1 <= counted.number <= 3


def test_the_time_to_find_is_the_same_where_nothing_is_in_doubt(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A tool whose markers come into view one after the other."""
    monkeypatch.setattr(AcquisitionBackoff, "due", lambda *_: True)
    always = [found_at(seed) for seed in range(4)]
    monkeypatch.undo()
    assert [found_at(seed) for seed in range(4)] == always


def found_at(seed: int) -> int:
    rng = np.random.default_rng(seed)
    tool = pointer(strobed=True)
    tracker = ToolTracker(CAMERAS, [tool], pixels=PIXELS_OF_ALL)
    true = body(tool, seed)
    true.velocity_mm_s = 150.0 * rng.standard_normal(3)
    seen_from = rng.integers(0, 100, 4)
    for centred in range(200):
        marker = centred % TURN
        reading = CAMERAS.project(true.markers_mm)[marker] + SIGMA_PX * rng.standard_normal(4)
        if centred < seen_from[marker]:
            reading[:] = np.nan
        (pose,) = tracker.step(
            centred * 5_000_000,
            centred,
            Measurements.of(
                reading[:, None], np.full((4, 1), SIGMA_PX), np.zeros((4, 1), np.int32)
            ),
            marker,
        )
        if pose.valid:
            return centred
        true.move(0.005)
    raise AssertionError("it was not found")


def test_why_it_was_not_found_is_told_until_it_is_looked_for_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    number, words = 0, "only sensors 1 and 2 of 4 saw it"

    def too_few(*_: object) -> StrobedAcquisition:
        nonlocal number
        number += 1
        return StrobedAcquisition(None, words, searched=True)

    monkeypatch.setattr(tool_search, "acquire_strobed", too_few)
    scene = lost()
    poses = [scene.strobed()[0] for _ in range(300)]
    assert {(pose.status, pose.reason) for pose in poses[8:]} == {(PoseStatus.MISSING, words)}
    # A sensor more may be enough at the very next exposure.
    assert number <= len(searched(1000.0, 0.3, turn=1)) + 2 * TURN
    (pose,) = [scene.strobed(blind=True)[0] for _ in range(3 * TURN)][-1:]
    assert pose.reason == "0 of 4 markers were seen in the last 250 ms"
