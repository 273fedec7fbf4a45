"""The kernel of a strobed tool's step: what NumPy makes of the same modes and readings."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from compute.camera.stack import CameraStack
from compute.mapping.table import CorrectionTable, Degree
from compute.measurement.measurement_model import MeasurementModel
from compute.measurement.measurements import Measurements
from compute.pose.estimation.pose_equations import PoseEquations
from compute.pose.estimation.pose_reliability import pose_reliability
from compute.pose.filtering import association
from compute.pose.filtering.association import ToolObservation, associate, without_peaks
from compute.pose.filtering.imm import ImmModel, ImmState
from compute.pose.filtering.native.kernel_arguments import load_kernels, step_kernel
from compute.pose.filtering.native.strobed_step import (
    FrameSteps,
    Step,
    StrobedStepKernel,
    ToolStep,
)
from compute.pose.filtering.pose_filter import STATES, PoseState, predict_measurement
from compute.pose.filtering.second_order import second_order_prediction
from compute.pose.rigid_body import CentredMarkers, RigidBody, ToolPose
from compute.pose.settings import ImmSettings, MotionMode, MotionSettings
from compute.pose.tool_tracking.tool_tracker import ToolTracker
from compute.reconstruction.solver import MIN_CAPACITY
from compute.signal.peaks import PeakFlag
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
from tests.compute.reconstruction.distorted_rig import distorted_rig, table
from tests.compute.reconstruction.solver_scenes import parameter_spread
from tests.compute.rig import PIXELS, rig

GATE = 1e-5
MANY = ImmSettings()
KINDS = (
    MANY,
    ImmSettings((MotionMode(1.0),)),
    ImmSettings((MotionMode(0.1), MotionMode(0.5, 0.2), MotionMode(1.0)), 0.1),
)
Made = tuple[ImmSettings, int, bool, Degree | None, int]
PARTS = ("rotation", "centroid_mm", "velocity_mm_s", "angular_velocity_rad_s")


class Case:
    """A random tool that modes know something of, seen by some cameras."""

    def __init__(
        self, kind: ImmSettings, sensors: int, distorted: bool, degree: Degree | None, seed: int
    ) -> None:
        self.rng = rng = np.random.default_rng(seed)
        cameras = CameraStack.of(distorted_rig(sensors) if distorted else rig(sensors))
        if seed % 3 == 0:
            cameras = replace(cameras, cubic_per_px2=rng.uniform(-3e-9, 3e-9, sensors))
        corrections = None if degree is None else table(degree, sensors, seed=seed % 7)
        covariance = parameter_spread(cameras, rng) if seed % 4 else None
        self.model = MeasurementModel.of(cameras, covariance, corrections)
        markers = 60.0 * rng.standard_normal((int(rng.integers(3, 6)), 3))
        self.centred = CentredMarkers.of(RigidBody("tool", markers, tuple(range(len(markers)))))
        self.common_errors = self.model.covariance_factor.shape[2] + (
            degree is not None
        ) * sensors * len(markers)
        self.imm = ImmModel.of(MotionSettings(), kind)
        self.step = StrobedStepKernel(self.model, self.imm, self.centred, self.common_errors, GATE)
        self.before = ImmState.of(self._state(), self.imm)
        for _ in range(int(rng.integers(0, 3))):
            # Told apart by what was read of some markers.
            lit = int(rng.integers(len(markers)))
            self.before = self.by_hand(self.before, 2_000_000, lit, self.measurements(lit)).imm  # type: ignore[assignment]

    def _state(self) -> PoseState:
        rng = self.rng
        mixed = rng.standard_normal((STATES, STATES))
        scale = np.array([1e-3] * 3 + [0.1] * 3 + [20.0] * 3 + [0.3] * 3)
        covariances = scale[:, None] * (mixed @ mixed.T / STATES + 0.2 * np.eye(STATES)) * scale
        common = 0.02 * scale[:, None] * rng.standard_normal((STATES, self.common_errors))
        speed, rate = 200.0 * rng.standard_normal(3), 2.0 * rng.standard_normal(3)
        place = MIDDLE_MM + rng.uniform(-150.0, 150.0, 3)
        return PoseState(7, random_rotation(rng), place, speed, rate, covariances, common)

    def measurements(
        self, lit: int, peaks: int = 1, missing: float = 0.0, off: float = 0.0
    ) -> Measurements:
        """What a frame shows of a marker: near where it must be, some missing, some in doubt.

        Of those with a probability ``off`` each is some standard deviations away.
        """
        rng, sensors = self.rng, len(self.model)
        place = self.before.widest_state.marker_positions(self.centred)[lit][None]
        where = self.model.linearise(place)[0][0] + 0.1 * rng.standard_normal(sensors)
        if off:
            away = rng.choice([-1.0, 1.0], sensors) * rng.choice([0.3, 1.0, 4.0, 20.0], sensors)
            where = where + np.where(rng.random(sensors) < off, away, 0.0)
        position = np.full((sensors, peaks), np.nan)
        position[:, 0] = np.where(rng.random(sensors) < missing, np.nan, where)
        position[:, 1:] = rng.uniform(0.0, PIXELS, (sensors, peaks - 1))
        flags = np.where(rng.random(position.shape) < 0.1, int(PeakFlag.POOR_FIT), 0)
        position = rng.permuted(position, axis=1)
        return Measurements.of(position, rng.uniform(0.03, 0.1, position.shape), flags)

    def by_hand(
        self, before: ImmState, after_ns: int, lit: int, measurements: Measurements
    ) -> ToolObservation:
        """The step by NumPy."""
        predicted = before.predict(before.widest_state.time_ns + after_ns)
        observation = ToolObservation(
            self.centred, np.array([lit]), predicted.widest_state, predicted
        )
        associate(self.model, [observation], measurements, GATE, 4.0)
        return observation

    def by_kernel(self, after_ns: int, lit: int, measurements: Measurements) -> Step:
        time_ns = self.before.widest_state.time_ns + after_ns
        found = take_alone(ToolStep(self.step, self.before, lit), time_ns, measurements)
        assert isinstance(found, Step)
        return found


def take_alone(
    step: ToolStep, time_ns: int, measurements: Measurements | None = None
) -> Step | PoseState:
    """A launch for one tool."""
    (found,) = FrameSteps(step.kernel.sensors, step.kernel.capacity).take(
        [step], time_ns, measurements
    )
    return found


def assert_same_state(found: PoseState, wanted: PoseState) -> None:
    assert found.time_ns == wanted.time_ns
    for name in PARTS:
        value = getattr(wanted, name)
        assert getattr(found, name) == pytest.approx(value, rel=1e-9, abs=1e-9)
    deviation = np.sqrt(wanted.covariance.diagonal())
    scale = deviation[:, None] * deviation
    assert found.covariance / scale == pytest.approx(wanted.covariance / scale, abs=1e-8)
    common = wanted.common / deviation[:, None]
    assert found.common / deviation[:, None] == pytest.approx(common, abs=1e-8)


def assert_same_regimes(found: ImmState, wanted: ImmState) -> None:
    assert_same_state(found.widest_state, wanted.widest_state)
    assert_same_state(found.combined, wanted.combined)
    assert found.mode_probabilities == pytest.approx(wanted.mode_probabilities, rel=1e-7, abs=1e-12)
    for name in ("offsets", "covariances"):
        value = getattr(wanted, name)
        size = np.abs(value).max(axis=(0, 1) if name == "covariances" else 0)
        assert (np.abs(getattr(found, name) - value) <= 1e-8 * size + 1e-12).all()


cases = st.tuples(
    st.sampled_from(KINDS),
    st.sampled_from([3, 4]),
    st.booleans(),
    st.sampled_from([None, 1, 3]),
    st.integers(0, 10**6),
)


@pytest.mark.slow
@settings(deadline=None, max_examples=80)
@given(
    cases,
    st.sampled_from([0, 1_000_000, 12_345_678]),
    st.sampled_from([0.0, 0.3, 1.0]),
    st.sampled_from([0.0, 0.3, 0.8]),
)
def test_any_step_is_taken_as_by_numpy(
    made: Made, after_ns: int, missing: float, off: float
) -> None:
    case = Case(*made)
    lit = int(case.rng.integers(len(case.centred.markers_mm)))
    measurements = case.measurements(lit, int(case.rng.integers(1, 4)), missing, off)
    wanted = case.by_hand(case.before, after_ns, lit, measurements)
    found = case.by_kernel(after_ns, lit, measurements)
    predicted = case.before.predict(case.before.widest_state.time_ns + after_ns)
    assert_same_regimes(found.predicted, predicted)
    if found.imm is None:
        # Not plain: it is left to NumPy, which may find one reading after the other.
        return
    assert_same_step(case, found, wanted, measurements)


def assert_same_step(
    case: Case, found: Step, wanted: ToolObservation, measurements: Measurements
) -> None:
    assert found.imm is not None
    assert wanted.imm is not None
    assert found.misfit == wanted.misfit
    assert (found.peaks == wanted.peaks).all()
    assert found.readings == wanted.readings
    assert found.nis == pytest.approx(wanted.nis, rel=1e-7, abs=1e-12)
    assert_same_regimes(found.imm, wanted.imm)
    if found.readings:
        assert found.whitened == pytest.approx(wanted.whitened[0], rel=1e-6, abs=1e-8)
    free = without_peaks(measurements, [wanted.peaks])
    excluded = wanted.excluded_nis(case.model, free, GATE)
    assert found.excluded == pytest.approx(excluded, rel=1e-6, abs=1e-9)


@settings(deadline=None, max_examples=40)
@given(cases, st.sampled_from([0, 1_000_000, 70_000_000]))
def test_what_is_expected_without_readings_is_as_by_numpy(made: Made, after_ns: int) -> None:
    case = Case(*made)
    time_ns = case.before.widest_state.time_ns + after_ns
    found, wanted = (
        take_alone(ToolStep(case.step, case.before), time_ns),
        case.before.predict_combined(time_ns),
    )
    assert isinstance(found, PoseState)
    assert_same_state(found, wanted)
    known, same = found.reported_pose(case.centred), wanted.reported_pose(case.centred)
    for name, value in vars(same).items():
        size = np.abs(value).max()
        assert getattr(known, name) == pytest.approx(value, rel=1e-9, abs=1e-9 * size)


@pytest.mark.slow
@settings(deadline=None, max_examples=30)
@given(st.integers(0, 10**6), st.integers(1, 4), st.booleans())
def test_tools_of_one_frame_are_as_each_by_itself_to_the_bit(seed: int, tools: int, lit: bool):
    cases = [Case(KINDS[seed % 3], 4, False, None, seed + 3 * number) for number in range(tools)]
    time_ns = max(case.before.widest_state.time_ns for case in cases) + 1_000_000
    marker = seed % 3 if lit else None
    measurements = cases[0].measurements(seed % 3)
    steps = [
        ToolStep(case.step, case.before, marker if number == 0 else None)
        for number, case in enumerate(cases)
    ]
    kernel = cases[0].step
    found = FrameSteps(kernel.sensors, kernel.capacity).take(steps, time_ns, measurements)
    for number, (case, one) in enumerate(zip(cases, found, strict=True)):
        alone = take_alone(steps[number], time_ns, measurements)
        if isinstance(one, Step):
            assert isinstance(alone, Step)
            assert (one.peaks == alone.peaks).all()
            assert (one.nis, one.readings, one.misfit) == (alone.nis, alone.readings, alone.misfit)
            assert (one.imm is None) == (alone.imm is None)
            if one.imm is None or alone.imm is None:
                continue
            assert (one.imm.packed == alone.imm.packed).all()
            one, alone = one.imm.combined, alone.imm.combined
        assert isinstance(alone, PoseState)
        assert isinstance(one, PoseState)
        for name in (*PARTS, "covariance", "common"):
            assert (getattr(one, name) == getattr(alone, name)).all()
        report, same = (vars(pose.reported_pose(case.centred)) for pose in (one, alone))
        assert all(np.array_equal(report[name], same[name]) for name in report)


@pytest.mark.slow
@settings(deadline=None, max_examples=60)
@given(cases, st.sampled_from([0.0, 0.2, 0.6]))
def test_the_reliability_of_any_pose_is_as_by_numpy(made: Made, missing: float) -> None:
    case = Case(*made)
    state, shape = case.before.combined, (len(case.centred.markers_mm), len(case.model))
    used = case.rng.random(shape) >= missing
    sigma = case.rng.uniform(0.03, 0.1, shape)
    pose = state.rotation, state.centroid_mm
    equations = PoseEquations(case.model, case.centred, np.where(used, 0.0, np.nan), sigma)
    wanted = pose_reliability(equations, *pose, 1e-4)
    found = case.step.reliability.of(used, sigma, *pose, 1e-4)
    few = np.count_nonzero(used) <= 6 or np.count_nonzero(used.any(axis=1)) < 3
    if found is None:
        # Left to NumPy: readings that do not determine the pose, such as those of two markers.
        assert (wanted.detectable_sigma, wanted.external_tip_mm) == (np.inf, np.inf)
        return
    assert not few
    for name in ("detectable_sigma", "external_tip_mm", "external_rotation_rad"):
        assert getattr(found, name) == pytest.approx(getattr(wanted, name), rel=1e-6)
    if np.isfinite(wanted.detectable_sigma):
        assert (found.marker, found.sensor) == (wanted.marker, wanted.sensor)


def test_the_reliability_of_too_many_readings_is_left_to_numpy() -> None:
    case = plain()
    used = np.ones((4, 4), dtype=np.bool_)
    pose = case.before.combined.rotation, case.before.combined.centroid_mm
    kernel = case.step.reliability
    assert kernel.of(used[:3], np.full((3, 4), 0.05), *pose, 1e-4) is not None
    nothing = kernel.of(used[:3] & False, np.full((3, 4), 0.05), *pose, 1e-4)
    assert nothing is None


def plain(seed: int = 1) -> Case:
    """One of which every reading can be taken."""
    return Case(MANY, 4, False, None, seed)


def test_most_steps_are_plain() -> None:
    """What is left to NumPy is rare: else the comparison above would compare nothing."""
    kept = [
        case.by_kernel(1_000_000, 0, case.measurements(0)).imm is not None
        for case in (Case(KINDS[seed % 3], 4, False, None, seed) for seed in range(40))
    ]
    assert np.mean(kept) > 0.8


def test_two_peaks_within_the_gate_are_left_to_numpy() -> None:
    case = plain()
    told = case.model.linearise(case.before.widest_state.marker_positions(case.centred)[0][None])[
        0
    ].T
    position = np.hstack([told, np.full((4, 1), np.nan)])
    position[2, 1] = position[2, 0] + 0.05
    two = Measurements.of(position, np.full((4, 2), 0.05), np.zeros((4, 2), np.int32))
    step = case.by_kernel(0, 0, two)
    assert step.imm is None
    assert step.readings == 0
    assert (step.peaks == -1).all()
    # A second one far off is none of it.
    position[2, 1] += 500.0
    far = Measurements.of(position, np.full((4, 2), 0.05), np.zeros((4, 2), np.int32))
    assert case.by_kernel(0, 0, far).readings == 4


@pytest.mark.parametrize(
    ("signs", "readings"), [((1.0, 1.0, 1.0, -1.0), 3), ((1.0, -1.0, 1.0, -1.0), 0)]
)
def test_readings_that_contradict_one_another_are_left_out_or_all_refused(
    signs: tuple[float, ...], readings: int
) -> None:
    case = plain(4)  # of exactly known cameras
    lit, widest_state = 1, case.before.widest_state
    arms = (case.centred.markers_mm @ widest_state.rotation.T)[[lit]]
    expected = case.model.predict(arms + widest_state.centroid_mm, with_common_errors=True)
    deviation = np.sqrt(
        predict_measurement(
            widest_state, arms, expected, expected.common_jacobian_px
        ).covariance.diagonal()
    )
    sigma, flags = np.full((4, 1), 0.05), np.zeros((4, 1), np.int32)
    # Each by itself is within its gate, as the tool is uncertain; together they contradict.
    apart = 3.0 * deviation * signs if readings == 0 else np.array([0.0, 0.0, 0.0, 3.0]) * deviation
    told = expected.reading_px.T
    wrong = Measurements.of(told + apart[:, None], sigma, flags)
    wanted = case.by_hand(case.before, 0, lit, wrong)
    assert (wanted.readings, wanted.misfit) == (readings, readings == 0)
    assert_same_step(case, case.by_kernel(0, lit, wrong), wanted, wrong)
    assert case.by_kernel(0, lit, Measurements.of(told, sigma, flags)).readings == 4


def test_a_peak_that_fits_once_the_others_were_used_is_not_counted_as_excluded() -> None:
    case = plain(4)
    state = case.before.widest_state
    marker = state.marker_positions(case.centred)[1]
    sigma, flags = np.full((4, 1), 0.05), np.zeros((4, 1), np.int32)
    fitting = 0
    for off_mm in np.linspace(0.0, 1.0, 101):
        # The tool is elsewhere: the readings agree with one another, and some leave their gates.
        moved = marker + off_mm * np.array([0.8, 0.0, 0.6])
        told = case.model.linearise(moved[None])[0].T
        measurements = Measurements.of(told, sigma, flags)
        wanted = case.by_hand(case.before, 0, 1, measurements)
        assert_same_step(case, case.by_kernel(0, 1, measurements), wanted, measurements)
        free = without_peaks(measurements, [wanted.peaks])
        off = wanted.excluded_nis(case.model, free, GATE)
        fitting += 0 < wanted.readings < 4 and not off.any()
    assert fitting


@pytest.mark.slow
@pytest.mark.parametrize("turn_rad", [0.02, 0.1, 0.3])
@pytest.mark.parametrize("seed", range(8))
def test_where_the_curvature_matters_it_is_taken_as_by_numpy(
    turn_rad: float, seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    case = Case(KINDS[seed % 3], 3 + seed % 3, seed % 2 == 1, (None, 1, 3)[seed % 3], seed)
    wide = case.before.covariances.copy()
    wide[:, :3, :3] += turn_rad**2 * np.eye(3)
    case.before = replace(
        case.before,
        covariances=wide,
        widest_state=replace(case.before.widest_state, covariance=wide[-1, :STATES, :STATES]),
    )
    asked = []
    monkeypatch.setattr(
        association,
        "second_order_prediction",
        lambda *given: asked.append(1) or second_order_prediction(*given),
    )
    measurements = case.measurements(2)
    wanted = case.by_hand(case.before, 1_000_000, 2, measurements)
    found = case.by_kernel(1_000_000, 2, measurements)
    assert found.imm is not None
    assert asked
    assert wanted.imm is not None
    assert (found.peaks == wanted.peaks).all()
    assert found.nis == pytest.approx(wanted.nis, rel=1e-7, abs=1e-12)
    assert_same_state(found.imm.widest_state, wanted.imm.widest_state)
    assert_same_state(found.imm.combined, wanted.imm.combined)
    assert found.imm.mode_probabilities == pytest.approx(
        wanted.imm.mode_probabilities, rel=1e-7, abs=1e-12
    )


def test_the_curvature_widens_the_gates() -> None:
    case = plain(4)
    wide = case.before.covariances.copy()
    wide[:, :3, :3] += 0.1**2 * np.eye(3)
    case.before = replace(
        case.before,
        covariances=wide,
        widest_state=replace(case.before.widest_state, covariance=wide[-1, :STATES, :STATES]),
    )
    told = case.model.linearise(case.before.widest_state.marker_positions(case.centred)[0][None])[
        0
    ].T
    sigma, flags = np.full((4, 1), 0.05), np.zeros((4, 1), np.int32)
    sigma[1:] = np.nan  # one reading alone is taken wherever its gate lets it
    taken = []
    for off_px in np.linspace(0.0, 400.0, 801):
        measurements = Measurements.of(told + off_px, sigma, flags)
        wanted = case.by_hand(case.before, 0, 0, measurements)
        assert (case.by_kernel(0, 0, measurements).peaks == wanted.peaks).all()
        taken.append(wanted.readings)
    assert taken[0] == 1
    assert taken[-1] == 0


def test_curvature_behind_a_lens_tells_nothing() -> None:
    case = plain()
    wide = case.before.covariances.copy()
    wide[:, 3:6, 3:6] += 5000.0**2 * np.eye(3)
    case.before = replace(
        case.before,
        covariances=wide,
        widest_state=replace(case.before.widest_state, covariance=wide[-1, :STATES, :STATES]),
    )
    wanted = case.by_hand(case.before, 1_000_000, 0, case.measurements(0))
    found = case.by_kernel(1_000_000, 0, case.measurements(0))
    assert found.imm is not None
    assert (found.readings, wanted.readings) == (0, 0)


@pytest.mark.slow
@pytest.mark.parametrize("hidden", [(), ((0, 0),), ((0, None),)], ids=["all", "one", "marker"])
@pytest.mark.parametrize("bent_mm", [0.0, 10.0], ids=["", "bent"])
def test_exposures_of_all_markers_between_those_of_one_are_as_by_numpy(
    hidden: tuple[tuple[int, int | None], ...], bent_mm: float
) -> None:
    """A strobe schedule may have slots that light all."""

    def followed(kernel: bool) -> list[ToolPose]:
        tool = pointer(strobed=True)
        tracker = ToolTracker(CAMERAS, [tool], None, CALIBRATION)
        if not kernel:
            tracker._tools[0].kernel = None
        scene = Scene([body(tool, 3)], tracker, seed=3)
        poses = [pose for _ in range(60) for pose in scene.strobed()]
        shown = scene.bodies[0]
        shown.tool = replace(
            tool, markers_mm=tool.markers_mm + bent_mm * np.eye(4, 3, k=-1) * [0.0, 0.0, 1.0]
        )
        for centred in range(80):
            if centred % 5 == 4:
                poses += scene._step(scene.readings(hidden)[0].T, None, None)
            else:
                poses += scene.strobed()
        return poses

    found, wanted = followed(True), followed(False)
    for one, other in zip(found, wanted, strict=True):
        assert (one.status, one.reason) == (other.status, other.reason)
        assert (one.readings_used, one.markers_used) == (other.readings_used, other.markers_used)
        if other.tip_mm is not None:
            assert one.tip_mm == pytest.approx(other.tip_mm, rel=1e-9)


def corrections(seed: int) -> CorrectionTable:
    return table(3, 4, 1.0, seed)


def follow(kernel: bool, covariance: Array | None, with_table: bool, seed: int) -> list[ToolPose]:
    """Poses of a tool that moves, jerks, is hidden, and has false peaks beside it."""
    tool = replace(pointer(strobed=True), max_tip_sd_mm=10.0)
    known = corrections(seed) if with_table else None
    tracker = ToolTracker(CAMERAS, [tool], None, covariance, known)
    if not kernel:
        tracker._tools[0].kernel = None
    one = Scene([body(tool, seed)], tracker, seed=seed)
    rng = np.random.default_rng(seed)
    moving = one.bodies[0]
    poses: list[ToolPose] = []
    for centred in range(600):
        if centred > 60:
            moving.velocity_mm_s = moving.velocity_mm_s + 8.0 * rng.standard_normal(3)
            moving.angular_velocity_rad_s = (
                moving.angular_velocity_rad_s + 0.05 * rng.standard_normal(3)
            )
        if centred in (200, 400):
            moving.velocity_mm_s = 400.0 * rng.standard_normal(3)
        if centred % 150 == 0:
            moving.centroid_mm, moving.velocity_mm_s = MIDDLE_MM.copy(), np.zeros(3)
        marker = centred % 4
        place = moving.markers_mm[marker][None]
        exact = CAMERAS.project(place)[0]
        if known is not None:
            exact = exact - known.at(place).value_px[0]
        peaks = np.full((4, 2), np.nan)
        peaks[:, 0] = exact + SIGMA_PX * rng.standard_normal(4)
        peaks[rng.random(4) < 0.05, 0] = np.nan
        false = rng.random(4) < 0.1
        peaks[false, 1] = peaks[false, 0] + rng.choice([-40.0, -2.0, 0.3, 3.0, 200.0], false.sum())
        if 300 <= centred < 320:
            peaks[:] = np.nan
        poses += one._step(peaks if centred % 2 else np.sort(peaks, axis=1), marker, None)
    return poses


@pytest.mark.slow
@pytest.mark.parametrize("covariance", [None, CALIBRATION], ids=["exact", "calibrated"])
@pytest.mark.parametrize("with_table", [False, True], ids=["", "table"])
def test_long_runs_are_the_same(covariance: Array | None, with_table: bool) -> None:
    found, wanted = (follow(kernel, covariance, with_table, 5) for kernel in (True, False))
    for one, other in zip(found, wanted, strict=True):
        assert (one.status, one.reason) == (other.status, other.reason)
        assert (one.readings_used, one.markers_used) == (other.readings_used, other.markers_used)
        if other.rotation is None:
            continue
        assert one.rotation == pytest.approx(other.rotation, rel=1e-9, abs=1e-9)
        for name in ("translation_mm", "tip_mm"):
            assert getattr(one, name) == pytest.approx(getattr(other, name), rel=1e-9)
        for name in ("covariance", "tip_covariance_mm2"):
            value = getattr(other, name)
            scale = np.sqrt(np.outer(value.diagonal(), value.diagonal()))
            assert getattr(one, name) / scale == pytest.approx(value / scale, abs=1e-6)
    assert sum(pose.valid for pose in wanted) > 200


@pytest.mark.slow
def test_the_same_input_gives_the_same_bits() -> None:
    first, second = (follow(True, CALIBRATION, False, 3) for _ in range(2))
    for one, other in zip(first, second, strict=True):
        assert one.status is other.status
        if one.covariance is not None:
            assert np.array_equal(one.covariance, other.covariance)  # type: ignore[arg-type]


def test_a_step_leaves_what_was_before_as_it_was() -> None:
    case = plain()
    first = case.by_kernel(1_000_000, 0, case.measurements(0))
    assert first.imm is not None
    kept = first.imm.packed.copy(), first.predicted.packed.copy()
    case.before = first.imm
    again = [case.by_kernel(1_000_000, 1, case.measurements(1)) for _ in range(3)]
    assert all(step.imm is not None for step in again)
    assert np.array_equal(first.imm.packed, kept[0])
    assert np.array_equal(first.predicted.packed, kept[1])


def test_kernels_are_there_before_the_first_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    """Trackers load no other kernel than was loaded for their number of sensors."""
    modules = [step_kernel(4, room).module for room in (0, MIN_CAPACITY)]
    for module in modules:
        monkeypatch.setattr(module, "execs", {})  # what other tests have loaded
    load_kernels(4)
    loaded = [set(module.execs) for module in modules]
    assert all(loaded)
    before = step_kernel.cache_info().misses
    follow(True, None, False, 1)
    for cameras in (CAMERAS, CameraStack.of(distorted_rig())):
        ToolTracker(cameras, [pointer(strobed=True)])
    assert step_kernel.cache_info().misses == before
    assert [set(module.execs) for module in modules] == loaded


def test_what_has_no_regimes_has_no_step() -> None:
    single = replace(ToolTracker(CAMERAS, []).settings, imm=KINDS[1])
    for tool, wanted, given_ in (
        (pointer(strobed=True), True, None),
        (pointer(), False, None),
        (pointer(strobed=True), False, single),
    ):
        tracker = ToolTracker(CAMERAS, [tool], given_)
        assert (tracker._tools[0].kernel is not None) is wanted
