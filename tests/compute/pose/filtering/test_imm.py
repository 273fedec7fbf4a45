"""ImmState of motion: one is the filter, several are consistent, and rest is told from motion."""

from dataclasses import replace

import numpy as np
import pytest

from compute.errors import InvalidParameter
from compute.measurement.measurement_model import MeasurementModel
from compute.pose.filtering.association import common_jacobian
from compute.pose.filtering.imm import IMM_STATES, ImmModel, ImmState
from compute.pose.filtering.pose_filter import (
    STATES,
    MeasurementPrediction,
    PoseState,
    predict,
    predict_measurement,
    update,
)
from compute.pose.rigid_body import CentredMarkers, PoseStatus
from compute.pose.settings import ImmSettings, MotionMode, MotionSettings, ToolTrackerSettings
from compute.pose.tool_tracking.tool_tracker import ToolTracker
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
BRIEF = ImmSettings((MotionMode(0.1), MotionMode(0.4), MotionMode(1.0)), 0.2)
LATER_NS = 20_000_000


def state(seed: int = 0) -> PoseState:
    """A moving tool of which all is uncertain, and correlated with the calibration's errors."""
    rng = np.random.default_rng(seed)
    mixed = rng.standard_normal((STATES, STATES))
    scale = np.array([2e-3] * 3 + [0.2] * 3 + [20.0] * 3 + [0.2] * 3)
    covariances = scale[:, None] * (mixed @ mixed.T / STATES + 0.2 * np.eye(STATES)) * scale
    common = 0.02 * scale[:, None] * rng.standard_normal((STATES, 28))
    speed, rate = 100.0 * rng.standard_normal(3), rng.standard_normal(3)
    return PoseState(0, random_rotation(rng), MIDDLE_MM, speed, rate, covariances, common)


def expectations(of: PoseState) -> tuple[MeasurementPrediction, Array]:
    """What is expected of a marker's readings, and how far they are off."""
    model = MeasurementModel.of(CAMERAS, CALIBRATION)
    lit = np.array([1])
    arms = CentredMarkers.of(pointer()).markers_mm[lit] @ of.rotation.T
    expected = model.predict(arms + of.centroid_mm, with_common_errors=True)
    prediction = predict_measurement(of, arms, expected, common_jacobian(expected, lit, 28))
    return prediction, np.array([0.2, -0.1, 0.05, 0.3])


def several(settings: ImmSettings) -> ImmState:
    """ImmState that differ, as readings have told them."""
    start = ImmState.of(state(), ImmModel.of(MOTION, settings)).predict(5_000_000)
    prediction, offsets = expectations(start.widest_state)
    return start.update(prediction, offsets, np.full(4, SIGMA_PX)).imm


def assert_same(found: PoseState, wanted: PoseState, rel: float = 1e-8) -> None:
    assert found.time_ns == wanted.time_ns
    for name in ("rotation", "centroid_mm", "velocity_mm_s", "angular_velocity_rad_s"):
        assert getattr(found, name) == pytest.approx(getattr(wanted, name), rel=rel, abs=1e-10)
    for name in ("covariance", "common"):
        value = getattr(wanted, name)
        least = 1e-9 * np.abs(value).max(initial=0.0)
        assert getattr(found, name) == pytest.approx(value, rel=rel, abs=least)


def test_a_single_regime_is_the_filter() -> None:
    one = ImmState.of(state(), ImmModel.of(MOTION, ImmSettings((MotionMode(1.0),))))
    assert_same(one.predict(LATER_NS, 3.0).combined, predict(state(), LATER_NS, MOTION, 3.0))
    one = one.predict(LATER_NS)
    wanted = predict(state(), LATER_NS, MOTION)
    assert_same(one.combined, wanted)
    prediction, offsets = expectations(wanted)
    sigma = np.full(4, SIGMA_PX)
    found, after = (
        one.update(prediction, offsets, sigma),
        update(wanted, prediction, offsets, sigma),
    )
    assert_same(found.imm.combined, after.state)
    assert found.nis == pytest.approx(after.nis)
    assert found.widest_nis == pytest.approx(after.nis)


def test_each_regime_takes_readings_as_a_filter_of_its_own() -> None:
    told_apart = several(ImmSettings())
    some = told_apart.predict(LATER_NS)
    prediction, offsets = expectations(some.widest_state)
    sigma = np.full(4, SIGMA_PX)
    found = some.update(prediction, offsets, sigma)
    weights = []
    for index, mode_probabilities in enumerate(some.mode_probabilities):
        inner = (
            some.covariances[index, :STATES, :STATES],
            some.covariances[index, :STATES, IMM_STATES:],
        )
        alone = replace(some.widest_state, covariance=inner[0], common=inner[1])
        own, _ = expectations(alone)
        rest = offsets - prediction.jacobian @ some.offsets[index, :6]
        after = update(alone, own, rest, sigma)
        kept = found.imm.covariances[index]
        assert kept[:STATES, :STATES] == pytest.approx(after.state.covariance, rel=1e-6, abs=1e-9)
        moved = (
            some.offsets[index, 6:9] + after.state.velocity_mm_s - some.widest_state.velocity_mm_s
        )
        widest_state = found.imm.widest_state.velocity_mm_s - some.widest_state.velocity_mm_s
        assert found.imm.offsets[index, 6:9] + widest_state == pytest.approx(moved, abs=1e-6)
        _, size = np.linalg.slogdet(own.covariance + np.diag(sigma**2))
        weights.append(mode_probabilities * np.exp(-0.5 * (after.nis + size)))
    assert found.imm.mode_probabilities == pytest.approx(
        np.array(weights) / np.sum(weights), rel=1e-6
    )


def test_the_whole_has_the_moments_of_all() -> None:
    some = several(ImmSettings())
    assert np.ptp(some.mode_probabilities) > 0.02
    rng = np.random.default_rng(1)
    which = rng.choice(len(some.mode_probabilities), 200_000, p=some.mode_probabilities)
    drawn = np.empty((len(which), 3))
    for index in range(len(some.mode_probabilities)):
        mine = which == index
        drawn[mine] = rng.multivariate_normal(
            some.offsets[index, 6:9], some.covariances[index, 6:9, 6:9], int(mine.sum())
        )
    assert some.combined.velocity_mm_s - some.widest_state.velocity_mm_s == pytest.approx(
        drawn.mean(axis=0), abs=0.2
    )
    wanted = np.cov(drawn.T)
    size = np.abs(wanted).max()
    assert some.combined.covariance[6:9, 6:9] == pytest.approx(wanted, abs=0.02 * size)


def test_what_is_expected_without_readings_is_what_is_expected_of_them() -> None:
    some = several(BRIEF)
    later = some.combined.time_ns + LATER_NS
    # The turns of the modes differ: second-order terms are left.
    assert_same(some.predict_combined(later), some.predict(later).combined, rel=2e-3)
    assert some.predict_combined(some.combined.time_ns) is some.combined


def test_a_lasting_acceleration_begins_as_anything_and_ends() -> None:
    settings = ImmSettings((MotionMode(0.1), MotionMode(0.5, 0.3), MotionMode(1.0)), 0.2)
    some = several(settings)
    # It has come from where accelerations do not last.
    some = replace(some, mode_probabilities=np.array([0.5, 0.0, 0.5])).predict(
        some.combined.time_ns + 1
    )
    acceleration = some.covariances[:, 12:, 12:IMM_STATES].diagonal(axis1=1, axis2=2)
    begun = np.array([0.5 * MOTION.acceleration_mm_s2] * 3 + [15.0] * 3)
    assert acceleration[1] == pytest.approx(begun**2, rel=1e-3)
    assert not acceleration[[0, 2]].any()
    assert not some.offsets[[0, 2], 12:].any()
    # One that goes on moves the tool.
    sure = replace(some, mode_probabilities=np.array([0.0, 1.0, 0.0]))
    offsets = some.offsets.copy()
    offsets[1, 12] += 400.0
    later = some.combined.time_ns + 10_000_000
    moved = (
        replace(sure, offsets=offsets).predict(later).offsets[1] - sure.predict(later).offsets[1]
    )
    assert moved[6] == pytest.approx(400.0 * 10e-3)
    assert moved[3] == pytest.approx(200.0 * 10e-3**2)


def test_times_add_up() -> None:
    model = ImmModel.of(MOTION, ImmSettings())
    step = 0.013
    combined, half = model.process_noise(2.0 * step), model.process_noise(step)
    jacobian = np.eye(IMM_STATES)
    for rate, switch_probability in ((3, 6), (0, 9), (6, 12), (9, 15)):
        jacobian[rate : rate + 3, switch_probability : switch_probability + 3] = step * np.eye(3)
    jacobian[3:6, 12:15] = jacobian[0:3, 15:18] = 0.5 * step**2 * np.eye(3)
    wanted = jacobian @ half @ jacobian.T + half
    for found, one in zip(combined, wanted, strict=True):
        assert found == pytest.approx(one, rel=1e-9, abs=1e-12 * np.abs(one).max())
        assert np.linalg.eigvalsh(found)[0] > -1e-12 * np.abs(found).max()
    chances = model.transition_probabilities(step)
    assert chances.sum(axis=1) == pytest.approx(np.ones(len(model)))
    assert model.transition_probabilities(2.0 * step) == pytest.approx(chances @ chances)
    # Poisson: what keeps to its mode that long.
    stays = np.exp(-1e-4 / ImmSettings().mean_sojourn_s)
    assert model.transition_probabilities(1e-4).diagonal() == pytest.approx(stays, rel=1e-6)


def test_regimes_tell_rest_from_motion() -> None:
    tool = pointer(strobed=True)
    one = Scene([body(tool)], ToolTracker(CAMERAS, [tool]), rate_hz=200.0)
    for _ in range(80):
        (pose,) = one.strobed()
    assert pose.valid
    imm = one.tracker._tools[0].imm
    assert imm is not None
    assert imm.mode_probabilities[0] > 0.9
    at_rest = np.trace(pose.tip_covariance_mm2)
    one.bodies[0].velocity_mm_s = np.array([150.0, 0.0, 0.0])
    for _ in range(3):
        (pose,) = one.strobed()
    imm = one.tracker._tools[0].imm
    assert imm is not None
    assert imm.mode_probabilities[0] < 0.1
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
    assert one.tracker._tools[0].imm is None


def test_regimes_are_kept_with_other_settings() -> None:
    tool = pointer(strobed=True)
    one = Scene([body(tool)], ToolTracker(CAMERAS, [tool]))
    for _ in range(40):
        one.strobed()
    before = one.tracker._tools[0].imm
    assert before is not None
    alike = ToolTracker(CAMERAS, [tool])
    alike.adopt_state(one.tracker)
    assert alike._tools[0].imm is before
    slow = replace(ToolTrackerSettings(), motion=MotionSettings(acceleration_mm_s2=100.0))
    other = ToolTracker(CAMERAS, [tool], slow)
    other.adopt_state(one.tracker)
    kept = other._tools[0].imm
    assert kept is not None
    assert kept.model is not before.model
    assert_same(kept.combined, before.combined)
    one.tracker = other
    assert one.strobed()[0].valid


def test_regimes_are_checked() -> None:
    with pytest.raises(InvalidParameter, match="the last one must be"):
        ImmSettings((MotionMode(1.0), MotionMode(0.1)))
    with pytest.raises(InvalidParameter, match=r"acceleration_fraction is -0\.1"):
        MotionMode(-0.1)
    with pytest.raises(InvalidParameter, match="manoeuvre_time_constant_s is 0"):
        MotionMode(0.1, 0.0)
