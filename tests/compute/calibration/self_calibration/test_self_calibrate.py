"""self_calibrate: wands, bodies, frames; bad starts, outliers, errors."""

from dataclasses import replace

import numpy as np
import pytest

from compute.calibration.bundle_adjustment.target_shape import KnownDistance
from compute.calibration.self_calibration.self_calibrate import self_calibrate
from compute.calibration.self_calibration.targets import (
    Recording,
    RigidBody,
    UnknownRigidBody,
    Wand,
)
from compute.camera.field_distortion import FieldDistortion
from compute.camera.model import SensorModel
from compute.errors import (
    DegeneratePoints,
    InvalidParameter,
    LumilineError,
    NoConvergence,
    ReadingOutsideSensor,
    TooFewPoints,
    UndeterminedParameters,
)
from compute.reconstruction.triangulation import reconstruct
from tests.compute.calibration.self_calibration.scenes import (
    BODY,
    MIDDLE,
    SIGMA_PX,
    WAND_MM,
    bars,
    body_markers,
    distances_kept,
    noisy,
    point_errors,
    wand_markers,
    wrong_by,
)
from tests.compute.rig import project, rig

WAND = Wand((0.0, WAND_MM))


def _recording(seed: int, poses: int = 100, *, sigma: bool = True) -> Recording:
    rng = np.random.default_rng(seed)
    read = noisy(rig(), wand_markers(poses, rng), rng)
    return Recording(WAND, read, np.full(read.shape, SIGMA_PX) if sigma else None)


def _body(markers: np.ndarray, sigma_mm: float = 0.0) -> RigidBody:
    return RigidBody(tuple((x, y, z) for x, y, z in markers.tolist()), sigma_mm)


def _known_cameras_rms(seed: int) -> float:
    rng = np.random.default_rng(seed)
    points = MIDDLE + rng.uniform(-200.0, 200.0, (500, 3))
    read = noisy(rig(), points[:, None], rng)[:, 0]
    away = reconstruct(rig(), read, np.full(4, SIGMA_PX)).position_mm - points
    return float(np.sqrt((away**2).sum(axis=1).mean()))


@pytest.mark.slow
@pytest.mark.parametrize("sigma", [True, False])
def test_wand_calibrates_nearly_as_well_as_if_the_cameras_were_known(sigma: bool) -> None:
    found = self_calibrate(rig(), [_recording(1, 200, sigma=sigma)])
    rms, _ = point_errors(found, np.random.default_rng(50))
    assert rms < 1.2 * _known_cameras_rms(50)
    assert found.rejected == ()
    assert found.dof == 200 * 3 - 22
    assert found.targets[0].used == 200
    assert [fit.sigma_px for fit in found.calibration.sensors] == pytest.approx(
        [SIGMA_PX] * 4, rel=0.25
    )


@pytest.mark.slow
def test_covariance_in_the_start_frame_is_honest() -> None:
    """Started from the right cameras the frame is theirs; over 8 runs errors fit covariances."""
    squares = [
        point_errors(self_calibrate(rig(), [_recording(200 + seed)]), np.random.default_rng(seed))[
            1
        ]
        for seed in range(12)
    ]
    # The calibration's part is common to a run's points: one run scatters by less than 1.
    assert np.mean(squares) == pytest.approx(3.0, abs=4.0 / np.sqrt(12))
    assert np.mean(squares) > 2.5


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.1, 0.2, 0.3])
def test_wrong_starts_lead_to_the_same_solution(share: float) -> None:
    recording = _recording(3, 60)
    right = self_calibrate(rig(), [recording])
    for seed in range(2):
        start = wrong_by(rig(), share, np.random.default_rng([seed, 77]))
        found = self_calibrate(start, [recording])
        assert found.chi2_per_dof == pytest.approx(right.chi2_per_dof, rel=1e-5)
        for one, other in zip(found.calibration.models, right.calibration.models, strict=True):
            assert one.principal_distance_px == pytest.approx(other.principal_distance_px, rel=1e-5)
            assert one.principal_point_px == pytest.approx(other.principal_point_px, abs=1e-2)


@pytest.mark.slow
def test_wrong_and_missing_readings_do_no_harm_and_are_named() -> None:
    rng = np.random.default_rng(4)
    recording = _recording(4, 150)
    readings = recording.readings_px.copy()
    poses = rng.choice(150, 12, replace=False)
    wrong = [(int(pose), int(rng.integers(2)), int(rng.integers(4))) for pose in poses]
    for number, place in enumerate(wrong):
        readings[place] += (-1.0) ** number * rng.uniform(5.0, 100.0)
    missing = rng.random(readings.shape) < 0.03
    missing[poses] = False
    readings[missing] = np.nan
    start = wrong_by(rig(), 0.1, rng)
    found = self_calibrate(start, [replace(recording, readings_px=readings)])
    named = {
        (one.pose - 1, one.marker - 1, int(one.sensor[1:]) - 1): one.normalised_residual
        for one in found.rejected
    }
    # Where another reading may as well be to blame, the pose is left out whole.
    assert set(named) <= set(wrong)
    assert len(named) >= 10
    assert found.targets[0].used == 150 - (len(wrong) - len(named))
    assert min(abs(off) for off in named.values()) > 20.0
    clean = self_calibrate(start, [_recording(4, 150)])
    rng = np.random.default_rng(51)
    assert distances_kept(found, rng) < 1.15 * distances_kept(clean, np.random.default_rng(51))


@pytest.mark.slow
def test_poses_with_two_wrong_readings_are_left_out_whole() -> None:
    recording = _recording(5)
    readings = recording.readings_px.copy()
    readings[[10, 40], 0, 1] += 30.0
    readings[[10, 40], 1, 3] -= 40.0
    found = self_calibrate(rig(), [replace(recording, readings_px=readings)])
    assert found.targets[0].used == 98
    assert found.chi2_per_dof < 1.3
    residuals = np.array(found.calibration.residuals_px, dtype=object).reshape(100, 2, 4)
    assert all(value is None for value in residuals[10].ravel())
    assert all(value is not None for value in residuals[11].ravel())


def test_rigid_body_of_known_shape_sets_the_frame() -> None:
    rng = np.random.default_rng(6)
    markers, rotation, translation = body_markers(BODY, 60, rng)
    read = noisy(rig(), markers, rng)
    recording = Recording(_body(BODY), read, np.full(read.shape, SIGMA_PX))
    found = self_calibrate(wrong_by(rig(), 0.1, rng), [recording], datum="first-pose")
    rms, nees = point_errors(found, np.random.default_rng(52), frame=(rotation[0], translation[0]))
    # The frame of one small body seen once is off by some tenths of a millimetre, and says so.
    assert rms < 3.0 * _known_cameras_rms(52)
    assert 0.5 < nees < 8.0


@pytest.mark.slow
def test_first_pose_covariance_is_honest() -> None:
    squares = []
    for seed in range(8):
        rng = np.random.default_rng([seed, 9])
        markers, rotation, translation = body_markers(BODY, 25, rng)
        read = noisy(rig(), markers, rng)
        recording = Recording(_body(BODY), read, np.full(read.shape, SIGMA_PX))
        found = self_calibrate(rig(), [recording], datum="first-pose")
        squares.append(point_errors(found, rng, frame=(rotation[0], translation[0]))[1])
    # Common to a run's points are the frame's six unknowns: up to sqrt(2 * 3) of scatter.
    assert np.mean(squares) == pytest.approx(3.0, abs=4.0 * np.sqrt(6.0 / 8))
    assert np.mean(squares) > 1.5


def test_rigid_body_of_unknown_shape_takes_its_scale_from_one_length() -> None:
    rng = np.random.default_rng(7)
    markers, _, _ = body_markers(BODY, 60, rng)
    target = UnknownRigidBody(4, KnownDistance(0, 1, 100.0, 0.01))
    found = self_calibrate(
        wrong_by(rig(), 0.1, rng), [Recording(target, noisy(rig(), markers, rng))]
    )
    shape = np.array(found.targets[0].markers_mm)
    between = np.linalg.norm(shape[:, None] - shape[None], axis=2)
    assert between == pytest.approx(np.linalg.norm(BODY[:, None] - BODY[None], axis=2), abs=0.5)
    assert distances_kept(found, np.random.default_rng(53)) < 1.0


def test_frame_at_four_unknown_places() -> None:
    rng = np.random.default_rng(8)
    frame = rng.uniform(-150.0, 150.0, (19, 3))
    markers, rotation, translation = body_markers(frame, 4, rng, 40.0)
    read = noisy(rig(), markers, rng)
    recording = Recording(_body(frame), read, np.full(read.shape, SIGMA_PX))
    found = self_calibrate(wrong_by(rig(), 0.2, rng), [recording], datum="first-pose")
    rms, _ = point_errors(found, np.random.default_rng(54), frame=(rotation[0], translation[0]))
    assert rms < 1.3 * _known_cameras_rms(54)


@pytest.mark.slow
def test_uncertain_length_makes_the_scale_uncertain() -> None:
    """The covariance moves points that are reconstructed apart by the length's own deviation."""
    read = _recording(9).readings_px
    sigma = np.full(read.shape, SIGMA_PX)
    ends = MIDDLE + np.array([[-100.0, -50.0, -80.0], [100.0, 50.0, 80.0]])
    exact = project(rig(), ends)
    spread = []
    for wand in (WAND, Wand((0.0, WAND_MM), 3.0)):
        found = self_calibrate(rig(), [Recording(wand, read, sigma)]).calibration
        steps = np.random.default_rng(1).multivariate_normal(
            np.zeros(28), np.array(found.covariance), 200, method="eigh"
        )
        lengths = []
        for step in steps:
            models = [
                model.retract(step[7 * number : 7 * number + 7])
                for number, model in enumerate(found.models)
            ]
            seen = reconstruct(models, exact, np.full(4, SIGMA_PX)).position_mm
            lengths.append(np.linalg.norm(seen[0] - seen[1]))
        spread.append(float(np.std(lengths)) / float(np.mean(lengths)))
    assert np.sqrt(spread[1] ** 2 - spread[0] ** 2) == pytest.approx(
        3.0 * np.sqrt(2.0) / WAND_MM, rel=0.2
    )


def test_wand_and_body_together() -> None:
    rng = np.random.default_rng(10)
    markers, _, _ = body_markers(BODY, 20, rng)
    body = Recording(_body(BODY), noisy(rig(), markers, rng))
    wand = _recording(10, 50, sigma=False)
    found = self_calibrate(rig(), [wand, body])
    assert [target.used for target in found.targets] == [50, 20]
    assert len(found.calibration.residuals_px) == 50 * 2 + 20 * 4
    assert found.dof == 50 * 3 + 20 * 10 - 22


@pytest.mark.slow
def test_sensors_with_distortion_get_theirs_adjusted() -> None:
    lens = FieldDistortion(((3, 0), (1, 2)), (-0.4, -0.6))

    def distorted(models: tuple[SensorModel, ...]) -> tuple[SensorModel, ...]:
        return tuple(replace(model, distortion=lens) for model in models)

    rng = np.random.default_rng(11)
    true = distorted(rig())
    read = noisy(true, wand_markers(150, rng), rng)
    sigma = np.full(read.shape, SIGMA_PX)
    plain = self_calibrate(rig(), [Recording(WAND, read, np.full(read.shape, 0.5))])
    blank = replace(lens, coefficients=(0.0, 0.0))
    start = tuple(replace(model, distortion=blank) for model in rig())
    found = self_calibrate(start, [Recording(WAND, read, sigma)])
    assert found.chi2_per_dof < 1.3
    assert plain.chi2_per_dof * 25.0 > 3.0
    cubic = [
        fit.model.distortion.coefficients[0]
        for fit in found.calibration.sensors
        if fit.model.distortion is not None
    ]
    spread = np.sqrt(np.diagonal(np.array(found.calibration.covariance)))[8::10]
    assert (np.abs(np.array(cubic) + 0.4) < 4.5 * spread).all()


def test_two_runs_give_the_same_bits() -> None:
    recording = _recording(12, 40)
    assert self_calibrate(rig(), [recording]) == self_calibrate(rig(), [recording])


def test_progress_rises_and_cancels() -> None:
    told: list[tuple[float, str]] = []

    def tell(fraction: float, stage: str) -> None:
        told.append((fraction, stage))

    self_calibrate(rig(), [_recording(13, 40)], progress=tell)
    fractions = [fraction for fraction, _ in told]
    assert fractions == sorted(fractions)
    assert fractions[-1] == 1.0
    assert len({stage for _, stage in told}) >= 4

    class Cancelled(Exception):
        pass

    def stop(fraction: float, stage: str) -> None:
        raise Cancelled

    with pytest.raises(Cancelled):
        self_calibrate(rig(), [_recording(13, 40)], progress=stop)


def _posed(middles: np.ndarray, directions: np.ndarray) -> Recording:
    rng = np.random.default_rng(14)
    return Recording(WAND, noisy(rig(), bars(MIDDLE + middles, directions), rng))


_RNG = np.random.default_rng(15)
_MIDDLES = _RNG.uniform(-60.0, 60.0, (80, 3))
_DIRECTIONS = _RNG.standard_normal((80, 3))
_FLAT = _DIRECTIONS * [1.0, 1.0, 0.0]
_CONE = np.column_stack([np.cos(np.arange(80)), np.sin(np.arange(80)), np.ones(80)])


@pytest.mark.parametrize(
    ("middles", "directions", "reason"),
    [
        (_MIDDLES, np.tile([1.0, 0.2, 0.1], (80, 1)), "all parallel"),
        (_MIDDLES, _FLAT, "all in one plane"),
        (_MIDDLES, _CONE, "on a cone"),
        (_MIDDLES * [1.0, 1.0, 0.0], _FLAT, "plane"),
    ],
)
def test_poses_all_alike_are_refused(middles, directions, reason: str) -> None:
    with pytest.raises(DegeneratePoints, match=reason):
        self_calibrate(rig(), [_posed(middles, directions)])


@pytest.mark.parametrize(
    ("length", "unit"), [(0.3, "given in m"), (30.0, "given in cm"), (11.8, "given in inches")]
)
def test_lengths_in_other_units_are_refused(length: float, unit: str) -> None:
    read = _recording(16, 40).readings_px
    for start in (rig(), wrong_by(rig(), 0.1, np.random.default_rng(3))):
        with pytest.raises(InvalidParameter, match=unit):
            self_calibrate(start, [Recording(Wand((0.0, length)), read)])


def test_a_length_that_is_twice_too_long_is_refused() -> None:
    read = _recording(16, 40).readings_px
    with pytest.raises(InvalidParameter, match=r"device (1\.9|2\.)\d+ times as large"):
        self_calibrate(rig(), [Recording(Wand((0.0, 2.0 * WAND_MM)), read)])


def test_too_few_poses_are_refused_with_how_many_would_do() -> None:
    with pytest.raises(TooFewPoints, match=r"7 poses, .* 22 unknowns .* about 11 would do"):
        self_calibrate(rig(), [_recording(17, 7)])


def test_wands_and_bodies_that_tell_no_length_are_refused() -> None:
    with pytest.raises(InvalidParameter, match="1 marker has no length"):
        Wand((0.0,))
    with pytest.raises(InvalidParameter, match="no two may coincide"):
        Wand((0.0, 0.0))
    with pytest.raises(InvalidParameter, match="between two of the 3"):
        UnknownRigidBody(3, KnownDistance(0, 3, 100.0, 0.1))
    with pytest.raises(InvalidParameter, match="both must be positive"):
        KnownDistance(0, 1, 100.0, 0.0)
    with pytest.raises(InvalidParameter, match="three or more"):
        UnknownRigidBody(2, KnownDistance(0, 1, 100.0, 0.1))


def test_bad_recordings_are_refused() -> None:
    good = _recording(18, 40)
    with pytest.raises(InvalidParameter, match=r"\(poses, 2, sensors\)"):
        Recording(WAND, good.readings_px[:, :1])
    with pytest.raises(InvalidParameter, match="infinite"):
        Recording(WAND, np.where(good.readings_px > 1000.0, np.inf, good.readings_px))
    with pytest.raises(InvalidParameter, match="must be positive"):
        Recording(WAND, good.readings_px, np.zeros(good.readings_px.shape))
    with pytest.raises(InvalidParameter, match="the device has 3"):
        self_calibrate(rig(3), [good])
    with pytest.raises(TooFewPoints, match="2 sensors"):
        self_calibrate(rig()[:2], [Recording(WAND, good.readings_px[..., :2])])
    with pytest.raises(InvalidParameter, match="no recordings"):
        self_calibrate(rig(), [])
    outside = good.readings_px.copy()
    outside[3, 1, 2] = 5000.0
    with pytest.raises(ReadingOutsideSensor, match="s3"):
        self_calibrate(rig(), [Recording(WAND, outside)])
    with pytest.raises(InvalidParameter, match="some not"):
        self_calibrate(rig(), [good, _recording(19, 40, sigma=False)])
    with pytest.raises(InvalidParameter, match="first-pose"):
        self_calibrate(rig(), [good], datum="first-pose")
    with pytest.raises(TooFewPoints, match="none of the 40 poses"):
        self_calibrate(rig(), [Recording(WAND, np.full((40, 2, 4), np.nan))])


@pytest.mark.slow
def test_readings_of_nothing_are_refused() -> None:
    """Random readings fit no wand: an error, whichever notices first, and no calibration."""
    rng = np.random.default_rng(20)
    read = rng.uniform(300.0, 1700.0, (30, 2, 4))
    with pytest.raises(LumilineError) as caught:
        self_calibrate(rig(), [Recording(WAND, read, np.full(read.shape, SIGMA_PX))])
    assert isinstance(
        caught.value,
        NoConvergence | UndeterminedParameters | InvalidParameter | TooFewPoints | DegeneratePoints,
    )
