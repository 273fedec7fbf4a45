"""Drift from stationary markers: detection, the sensor at fault, update of the calibration."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from compute.calibration.calibrate import calibrate
from compute.calibration.drift.calibration_update import update_calibration
from compute.calibration.drift.drift_detection import check_drift
from compute.calibration.drift.stability_check import StationaryMarkers
from compute.calibration.result import Calibration
from compute.calibration.settings import CalibrationSettings
from compute.camera.model import SensorModel
from compute.camera.stack import CameraStack
from compute.errors import InvalidParameter, NonFiniteValue, TooFewPoints, UnknownSensor
from compute.reconstruction.triangulation import reconstruct
from tests.compute.rig import (
    THIRD_LENS_MM,
    control_points,
    geometry,
    project,
    rig,
    turned_about_lens,
)

Array = NDArray[np.float64]

SIGMA_PX = 0.1
PLACE_MM = 0.02
RUNS = 60
HERE = np.zeros(3)
IN_THE_VOLUME_MM = np.array([50.0, -80.0, 1450.0])


def _noisy(models: tuple[SensorModel, ...], points: Array, rng: np.random.Generator) -> Array:
    exact = project(models, points)
    return exact + SIGMA_PX * rng.standard_normal(exact.shape)


def _calibration(seed: int, origin_mm: Array = HERE, distortion: str = "none") -> Calibration:
    rng = np.random.default_rng([seed, 1])
    points = control_points(40, seed)
    read = _noisy(rig(), points, rng)
    settings = CalibrationSettings(distortion=distortion)
    sigma = np.full(read.shape, SIGMA_PX)
    return calibrate(points - origin_mm, read, geometry(rig()), sigma, settings)


def _moved(parameter: int, change: float, origin_mm: Array = HERE) -> tuple[SensorModel, ...]:
    """The rig with its third sensor changed, turned about its lens, seen from another origin."""
    models = [_seen_from(model, origin_mm) for model in rig()]
    step = np.zeros(7)
    step[parameter] = change
    distance = models[2].principal_distance_px + step[0]
    lens = THIRD_LENS_MM - origin_mm
    models[2] = replace(
        turned_about_lens(models[2], step[2:5], lens), principal_distance_px=distance
    )
    return tuple(models)


def _seen_from(model: SensorModel, origin_mm: Array) -> SensorModel:
    x, _, z = model.rotation @ origin_mm
    return replace(model, offset_x_mm=model.offset_x_mm + x, offset_z_mm=model.offset_z_mm + z)


def _still(seed: int, models: tuple[SensorModel, ...], *, places: bool) -> StationaryMarkers:
    rng = np.random.default_rng([seed, 2])
    points = control_points(8, seed + 1000)
    now = _noisy(models, points, rng)
    if places:
        known = points + PLACE_MM * rng.standard_normal(points.shape)
        return StationaryMarkers(now, positions_mm=known, position_sigma_mm=PLACE_MM)
    return StationaryMarkers(now, earlier_px=_noisy(rig(), points, rng))


@pytest.mark.parametrize("places", [True, False])
def test_chance_of_a_good_calibration_is_spread_evenly(places: bool) -> None:
    """The p values of unchanged devices are what they say: even between 0 and 1."""
    checks = [
        check_drift(_calibration(seed), _still(seed, rig(), places=places)) for seed in range(RUNS)
    ]
    values = np.sort([check.p_value for check in checks])
    away = np.abs(values - (np.arange(RUNS) + 0.5) / RUNS).max()
    assert away < 1.95 / np.sqrt(RUNS)  # Kolmogorov's limit at one in a thousand
    assert sum(not check.good for check in checks) <= 4


@pytest.mark.parametrize("places", [True, False])
@pytest.mark.parametrize(
    ("parameter", "name", "change"),
    [(4, "rotation_z_rad", 3e-3), (3, "rotation_y_rad", 4e-4), (0, "principal_distance_px", 20.0)],
)
def test_the_sensor_that_moved_is_named_and_how(
    places: bool, parameter: int, name: str, change: float
) -> None:
    named = explained = 0
    residual = []
    for seed in range(20):
        check = check_drift(
            _calibration(seed), _still(seed, _moved(parameter, change), places=places)
        )
        named += [sensor.moved for sensor in check.sensors] == [False, False, True, False]
        third = check.sensors[2]
        assert not check.good
        if third.parameter == name:
            explained += 1
            assert third.change is not None
            assert third.change_sigma is not None
            residual.append((third.change - change) / third.change_sigma)
    assert named >= 18
    assert explained >= 16
    assert np.mean(np.square(residual)) == pytest.approx(
        1.0, abs=4.0 * np.sqrt(2.0 / len(residual))
    )


def test_a_set_that_moved_as_a_whole_blames_no_sensor() -> None:
    rng = np.random.default_rng(5)
    points = control_points(8, 77)
    turn = Rotation.from_rotvec([1e-3, 0.0, 2e-3]).as_matrix()
    middle = points.mean(axis=0)
    now = (points - middle) @ turn.T + middle + [0.5, 0.0, 0.0]
    still = StationaryMarkers(_noisy(rig(), now, rng), earlier_px=_noisy(rig(), points, rng))
    check = check_drift(_calibration(1), still)
    assert not check.good
    assert check.rigid_motion
    assert check.rotation_rad == pytest.approx(np.sqrt(5.0) * 1e-3, rel=0.3)
    assert check.translation_mm == pytest.approx(0.5, rel=0.3)
    two = _moved(4, 3e-3)
    two = (two[0].retract(np.array([0.0, 0.0, 0.0, 0.0, -4e-3, 0.0, 0.0])), *two[1:])
    moved = StationaryMarkers(_noisy(two, points, rng), earlier_px=_noisy(rig(), points, rng))
    assert not check_drift(_calibration(1), moved).rigid_motion


def _error(calibration: Calibration, models: tuple[SensorModel, ...]) -> float:
    points = control_points(400, 9)
    exact = project(models, points)
    found = reconstruct(calibration.models, exact, np.full(4, SIGMA_PX))
    return float(np.sqrt(((found.position_mm - points) ** 2).sum(axis=1).mean()))


@pytest.mark.slow
@pytest.mark.parametrize("places", [True, False])
def test_update_takes_the_drift_away(places: bool) -> None:
    before, after, own = [], [], []
    moved = _moved(4, 6e-3)
    for seed in range(10):
        calibration = _calibration(seed)
        updated = update_calibration(
            calibration, _still(seed, moved, places=places), sensors=["s3"]
        )
        assert updated.method == "update"
        before.append(_error(calibration, moved))
        after.append(_error(updated, moved))
        own.append(_error(calibration, rig()))
        if not places:
            assert updated.models[0] == calibration.models[0]
    left = np.mean(np.square(after)) - np.mean(np.square(own))
    assert left < 0.1 * (np.mean(np.square(before)) - np.mean(np.square(own)))


@pytest.mark.slow
@pytest.mark.parametrize("places", [True, False])
def test_covariance_of_an_update_is_honest(places: bool) -> None:
    """The changed parameter of the changed sensor: off by what its deviation says."""
    allowance = {"rotation_z_rad": 3e-3}
    residual = []
    for seed in range(40):
        change = 3e-3 * float(np.random.default_rng([seed, 3]).standard_normal())
        moved = _moved(4, change)
        updated = update_calibration(
            _calibration(seed),
            _still(seed, moved, places=places),
            sensors=["s3"],
            allowance=allowance,
        )
        covariance = np.array(updated.covariance)
        turn = (
            Rotation.from_rotvec(updated.models[2].rotation_vector_rad)
            * Rotation.from_rotvec(moved[2].rotation_vector_rad).inv()
        ).as_rotvec()[2]
        residual.append(turn / np.sqrt(covariance[18, 18]))
    assert np.mean(np.square(residual)) == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / 40))


def test_few_markers_change_little() -> None:
    """One marker decides one combination; the rest keeps its old uncertainty and the new."""
    calibration = _calibration(3)
    still = _still(3, rig(), places=False)
    one = StationaryMarkers(still.readings_px[:1], earlier_px=still.earlier_px[:1])
    updated = update_calibration(calibration, one)
    old, new = np.diagonal(calibration.covariance), np.diagonal(updated.covariance)
    turns = [2, 3, 4, 0]
    assert (new[turns] > old[turns]).all()
    assert new[1] == pytest.approx(old[1], rel=1e-9)


@pytest.mark.parametrize("places", [True, False])
@pytest.mark.parametrize("origin_mm", [HERE, IN_THE_VOLUME_MM], ids=["bar", "volume"])
def test_sensor_that_turned_about_its_lens_is_described_wherever_the_origin_is(
    places: bool, origin_mm: Array
) -> None:
    """A knock turns a sensor where it stands; the world's origin has nothing to do with that."""
    turned = _moved(3, 3e-3)
    still = _still(2, turned, places=places)
    if places:
        assert still.positions_mm is not None
        still = replace(still, positions_mm=still.positions_mm - origin_mm)
    calibration = _calibration(2, origin_mm)
    third = check_drift(calibration, still).sensors[2]
    assert third.parameter == "rotation_y_rad"
    assert third.change == pytest.approx(3e-3, abs=4 * float(third.change_sigma or 0.0))
    assert float(third.p_value_with_change or 0.0) > 0.01
    updated = update_calibration(calibration, still, sensors=["s3"])
    shift = _lens_in_frame(updated.models[2], origin_mm)
    shift -= _lens_in_frame(calibration.models[2], origin_mm)
    # Known positions also say more of where the lens is; its distance hangs on the focal length.
    assert abs(shift[0]) < (0.3 if places else 0.03)
    if not places:
        assert abs(shift[1]) < 0.03
    points = control_points(400, 9)
    exact = project(turned, points)
    residual = CameraStack.of(updated.models).project(points - origin_mm) - exact
    assert np.sqrt((residual[:, 2] ** 2).mean()) < 2.0 * SIGMA_PX


def _lens_in_frame(model: SensorModel, origin_mm: Array) -> Array:
    """The third lens in the sensor's frame, across its slit, (2,): 0 if the model is right."""
    x, _, z = model.rotation @ (THIRD_LENS_MM - origin_mm)
    return np.array([x + model.offset_x_mm, z + model.offset_z_mm])


@pytest.mark.slow
@pytest.mark.parametrize("sigma_px", [5e-4, 2e-3])
def test_update_of_a_calibration_with_unknown_distortion_converges(sigma_px: float) -> None:
    """Markers read a hundred times as precisely as those of the calibration, which knows little."""
    rng = np.random.default_rng(5)
    calibration = _calibration(5, distortion="auto")
    points = control_points(19, 1005)
    moved = _moved(3, 2e-3)
    exact = project(moved, points)
    still = StationaryMarkers(
        exact + sigma_px * rng.standard_normal(exact.shape),
        np.full(exact.shape, sigma_px),
        positions_mm=points,
    )
    updated = update_calibration(calibration, still)
    assert _error(updated, moved) < _error(calibration, rig())


def test_missing_readings_are_left_out() -> None:
    still = _still(4, rig(), places=True)
    readings = still.readings_px.copy()
    readings[2, 1] = np.nan
    readings[:, 3] = np.nan
    check = check_drift(_calibration(4), replace(still, readings_px=readings))
    assert check.dof == 23
    assert [sensor.readings for sensor in check.sensors] == [8, 7, 8, 0]
    assert check.good
    update_calibration(_calibration(4), replace(still, readings_px=readings))


def test_bad_still_sets_are_refused() -> None:
    calibration, still = _calibration(6), _still(6, rig(), places=True)
    with pytest.raises(InvalidParameter, match="one of them"):
        check_drift(calibration, StationaryMarkers(still.readings_px))
    with pytest.raises(InvalidParameter, match="one of them"):
        check_drift(calibration, replace(still, earlier_px=still.readings_px))
    with pytest.raises(InvalidParameter, match=r"\(N, 4\)"):
        check_drift(calibration, replace(still, readings_px=still.readings_px[:, :3]))
    with pytest.raises(InvalidParameter, match="positions have shape"):
        check_drift(calibration, replace(still, positions_mm=still.positions_mm[:3]))
    with pytest.raises(InvalidParameter, match="position_sigma_mm is -1"):
        check_drift(calibration, replace(still, position_sigma_mm=-1.0))
    assert still.positions_mm is not None
    places = still.positions_mm.copy()
    places[1, 0] = np.nan
    with pytest.raises(NonFiniteValue, match="position 2"):
        check_drift(calibration, replace(still, positions_mm=places))
    with pytest.raises(TooFewPoints, match="no stationary marker"):
        check_drift(calibration, replace(still, readings_px=np.full((8, 4), np.nan)))
    with pytest.raises(UnknownSensor, match="no sensor s9"):
        update_calibration(calibration, still, sensors=["s9"])
    with pytest.raises(InvalidParameter, match="allowance has nonsense"):
        update_calibration(calibration, still, allowance={"nonsense": 1.0})
    with pytest.raises(InvalidParameter, match="positive standard deviation"):
        update_calibration(calibration, still, allowance={"rotation_x_rad": 0.0})
