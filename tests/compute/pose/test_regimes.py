"""Regimes of motion: one is the filter, several are consistent, and rest is told from motion."""

from dataclasses import replace

import numpy as np
import pytest

from compute.errors import InvalidParameter
from compute.pose.association import common_slopes
from compute.pose.marker_frame import MarkerFrame
from compute.pose.pose_filter import (
    STATES,
    Innovations,
    PoseState,
    innovations,
    predict,
    update,
)
from compute.pose.reading_model import ReadingModel
from compute.pose.regime_model import MOVING, RegimeModel
from compute.pose.regimes import Regimes
from compute.pose.settings import MotionSettings, Regime, RegimeSettings, ToolTrackerSettings
from compute.pose.tool_pose import PoseStatus
from compute.pose.tool_tracker import ToolTracker
from tests.compute.pose.scene import (
    CALIBRATION,
    CAMERAS,
    MIDDLE_MM,
    SIGMA_PX,
    Array,
    Scene,
    body,
    pointer,
    random_rotation,
)

MOTION = MotionSettings()
BRIEF = RegimeSettings((Regime(0.1), Regime(0.4), Regime(1.0)), 0.2)
LATER_NS = 20_000_000


def state(seed: int = 0) -> PoseState:
    """A moving tool of which all is uncertain, and correlated with the calibration's errors."""
    rng = np.random.default_rng(seed)
    mixed = rng.standard_normal((STATES, STATES))
    scale = np.array([2e-3] * 3 + [0.2] * 3 + [20.0] * 3 + [0.2] * 3)
    spread = scale[:, None] * (mixed @ mixed.T / STATES + 0.2 * np.eye(STATES)) * scale
    common = 0.02 * scale[:, None] * rng.standard_normal((STATES, 28))
    speed, rate = 100.0 * rng.standard_normal(3), rng.standard_normal(3)
    return PoseState(0, random_rotation(rng), MIDDLE_MM, speed, rate, spread, common)


def expectations(of: PoseState) -> tuple[Innovations, Array]:
    """What is expected of a marker's readings, and how far they are off."""
    model = ReadingModel.of(CAMERAS, CALIBRATION)
    lit = np.array([1])
    arms = MarkerFrame.of(pointer()).markers_mm[lit] @ of.rotation.T
    expected = model.full(arms + of.centroid_mm)
    told = innovations(of, arms, expected, common_slopes(expected, lit, 28))
    return told, np.array([0.2, -0.1, 0.05, 0.3])


def several(settings: RegimeSettings) -> Regimes:
    """Regimes that differ, as readings have told them."""
    start = Regimes.of(state(), RegimeModel.of(MOTION, settings)).predict(5_000_000)
    told, off = expectations(start.widest)
    return start.update(told, off, np.full(4, SIGMA_PX)).regimes


def assert_same(found: PoseState, wanted: PoseState, rel: float = 1e-8) -> None:
    assert found.time_ns == wanted.time_ns
    for name in ("rotation", "centroid_mm", "velocity_mm_s", "turn_rate_rad_s"):
        assert getattr(found, name) == pytest.approx(getattr(wanted, name), rel=rel, abs=1e-10)
    for name in ("covariance", "common"):
        value = getattr(wanted, name)
        least = 1e-9 * np.abs(value).max(initial=0.0)
        assert getattr(found, name) == pytest.approx(value, rel=rel, abs=least)


def test_a_single_regime_is_the_filter() -> None:
    one = Regimes.of(state(), RegimeModel.of(MOTION, RegimeSettings((Regime(1.0),))))
    assert_same(one.predict(LATER_NS, 3.0).whole, predict(state(), LATER_NS, MOTION, 3.0))
    one = one.predict(LATER_NS)
    wanted = predict(state(), LATER_NS, MOTION)
    assert_same(one.whole, wanted)
    told, off = expectations(wanted)
    sigma = np.full(4, SIGMA_PX)
    found, after = one.update(told, off, sigma), update(wanted, told, off, sigma)
    assert_same(found.regimes.whole, after.state)
    assert found.nis == pytest.approx(after.nis)
    assert found.widest_nis == pytest.approx(after.nis)


def test_each_regime_takes_readings_as_a_filter_of_its_own() -> None:
    told_apart = several(RegimeSettings())
    some = told_apart.predict(LATER_NS)
    told, off = expectations(some.widest)
    sigma = np.full(4, SIGMA_PX)
    found = some.update(told, off, sigma)
    weights = []
    for index, chance in enumerate(some.chance):
        inner = some.spread[index, :STATES, :STATES], some.spread[index, :STATES, MOVING:]
        alone = replace(some.widest, covariance=inner[0], common=inner[1])
        own, _ = expectations(alone)
        rest = off - told.slopes @ some.off[index, :6]
        after = update(alone, own, rest, sigma)
        kept = found.regimes.spread[index]
        assert kept[:STATES, :STATES] == pytest.approx(after.state.covariance, rel=1e-6, abs=1e-9)
        moved = some.off[index, 6:9] + after.state.velocity_mm_s - some.widest.velocity_mm_s
        widest = found.regimes.widest.velocity_mm_s - some.widest.velocity_mm_s
        assert found.regimes.off[index, 6:9] + widest == pytest.approx(moved, abs=1e-6)
        _, size = np.linalg.slogdet(own.covariance + np.diag(sigma**2))
        weights.append(chance * np.exp(-0.5 * (after.nis + size)))
    assert found.regimes.chance == pytest.approx(np.array(weights) / np.sum(weights), rel=1e-6)


def test_the_whole_has_the_moments_of_all() -> None:
    some = several(RegimeSettings())
    assert np.ptp(some.chance) > 0.02
    rng = np.random.default_rng(1)
    which = rng.choice(len(some.chance), 200_000, p=some.chance)
    drawn = np.empty((len(which), 3))
    for index in range(len(some.chance)):
        mine = which == index
        drawn[mine] = rng.multivariate_normal(
            some.off[index, 6:9], some.spread[index, 6:9, 6:9], int(mine.sum())
        )
    assert some.whole.velocity_mm_s - some.widest.velocity_mm_s == pytest.approx(
        drawn.mean(axis=0), abs=0.2
    )
    wanted = np.cov(drawn.T)
    size = np.abs(wanted).max()
    assert some.whole.covariance[6:9, 6:9] == pytest.approx(wanted, abs=0.02 * size)


def test_what_is_expected_without_readings_is_what_is_expected_of_them() -> None:
    some = several(BRIEF)
    later = some.whole.time_ns + LATER_NS
    # The turns of the regimes differ: second-order terms are left.
    assert_same(some.ahead(later), some.predict(later).whole, rel=2e-3)
    assert some.ahead(some.whole.time_ns) is some.whole


def test_a_lasting_acceleration_begins_as_anything_and_ends() -> None:
    settings = RegimeSettings((Regime(0.1), Regime(0.5, 0.3), Regime(1.0)), 0.2)
    some = several(settings)
    # It has come from where accelerations do not last.
    some = replace(some, chance=np.array([0.5, 0.0, 0.5])).predict(some.whole.time_ns + 1)
    acceleration = some.spread[:, 12:, 12:MOVING].diagonal(axis1=1, axis2=2)
    begun = np.array([0.5 * MOTION.acceleration_mm_s2] * 3 + [15.0] * 3)
    assert acceleration[1] == pytest.approx(begun**2, rel=1e-3)
    assert not acceleration[[0, 2]].any()
    assert not some.off[[0, 2], 12:].any()
    # One that goes on moves the tool.
    sure = replace(some, chance=np.array([0.0, 1.0, 0.0]))
    off = some.off.copy()
    off[1, 12] += 400.0
    later = some.whole.time_ns + 10_000_000
    moved = replace(sure, off=off).predict(later).off[1] - sure.predict(later).off[1]
    assert moved[6] == pytest.approx(400.0 * 10e-3)
    assert moved[3] == pytest.approx(200.0 * 10e-3**2)


def test_times_add_up() -> None:
    model = RegimeModel.of(MOTION, RegimeSettings())
    step = 0.013
    whole, half = model.noise(2.0 * step), model.noise(step)
    slopes = np.eye(MOVING)
    for rate, change in ((3, 6), (0, 9), (6, 12), (9, 15)):
        slopes[rate : rate + 3, change : change + 3] = step * np.eye(3)
    slopes[3:6, 12:15] = slopes[0:3, 15:18] = 0.5 * step**2 * np.eye(3)
    wanted = slopes @ half @ slopes.T + half
    for found, one in zip(whole, wanted, strict=True):
        assert found == pytest.approx(one, rel=1e-9, abs=1e-12 * np.abs(one).max())
        assert np.linalg.eigvalsh(found)[0] > -1e-12 * np.abs(found).max()
    chances = model.switching(step)
    assert chances.sum(axis=1) == pytest.approx(np.ones(len(model)))
    assert model.switching(2.0 * step) == pytest.approx(chances @ chances)
    # Poisson: what keeps to its regime that long.
    stays = np.exp(-1e-4 / RegimeSettings().mean_s)
    assert model.switching(1e-4).diagonal() == pytest.approx(stays, rel=1e-6)


def test_regimes_tell_rest_from_motion() -> None:
    tool = pointer(strobed=True)
    one = Scene([body(tool)], ToolTracker(CAMERAS, [tool]), rate_hz=200.0)
    for _ in range(80):
        (pose,) = one.strobed()
    assert pose.valid
    regimes = one.tracker._tools[0].regimes
    assert regimes is not None
    assert regimes.chance[0] > 0.9
    at_rest = np.trace(pose.tip_covariance_mm2)
    one.bodies[0].velocity_mm_s = np.array([150.0, 0.0, 0.0])
    for _ in range(3):
        (pose,) = one.strobed()
    regimes = one.tracker._tools[0].regimes
    assert regimes is not None
    assert regimes.chance[0] < 0.1
    # It is known that it is not known any more.
    assert pose.status is not PoseStatus.OK or np.trace(pose.tip_covariance_mm2) > 2.0 * at_rest
    for _ in range(60):
        before = one.bodies[0].tip_world_mm
        (pose,) = one.strobed()
    assert pose.valid, pose.reason
    assert pose.tip_mm == pytest.approx(before, abs=2.0)


def test_tools_that_are_lit_together_have_a_single_filter() -> None:
    one = Scene([body(pointer())], ToolTracker(CAMERAS, [pointer()]))
    assert one.together()[0].valid
    assert one.tracker._tools[0].regimes is None


def test_regimes_are_kept_with_other_settings() -> None:
    tool = pointer(strobed=True)
    one = Scene([body(tool)], ToolTracker(CAMERAS, [tool]))
    for _ in range(40):
        one.strobed()
    before = one.tracker._tools[0].regimes
    assert before is not None
    alike = ToolTracker(CAMERAS, [tool])
    alike.keep(one.tracker)
    assert alike._tools[0].regimes is before
    slow = replace(ToolTrackerSettings(), motion=MotionSettings(acceleration_mm_s2=100.0))
    other = ToolTracker(CAMERAS, [tool], slow)
    other.keep(one.tracker)
    kept = other._tools[0].regimes
    assert kept is not None
    assert kept.model is not before.model
    assert_same(kept.whole, before.whole)
    one.tracker = other
    assert one.strobed()[0].valid


def test_regimes_are_checked() -> None:
    with pytest.raises(InvalidParameter, match="the last one must be"):
        RegimeSettings((Regime(1.0), Regime(0.1)))
    with pytest.raises(InvalidParameter, match=r"share is -0\.1"):
        Regime(-0.1)
    with pytest.raises(InvalidParameter, match="steady_s is 0"):
        Regime(0.1, 0.0)
