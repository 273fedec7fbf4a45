"""Precision: against reconstruction, noisy readings and scaling laws."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from compute.camera.stack import CameraStack
from compute.errors import InvalidParameter
from compute.planning.precision import point_precision, precision_from_jacobian
from compute.reconstruction.point_batch import PointFlag
from compute.reconstruction.triangulation import reconstruct
from tests.compute.rig import camera, control_points, rig

SIGMA = np.array([0.05, 0.1, 0.02, 0.4])


def test_it_is_what_the_reconstruction_says() -> None:
    points = control_points(19)
    cameras = CameraStack.of(rig(4))
    readings = cameras.project(points)
    readings[::3, 1] = np.nan
    readings[5, :2] = np.nan
    sigma = np.where(np.isfinite(readings), SIGMA, np.nan)
    batch = reconstruct(cameras, readings, SIGMA)
    planned = point_precision(cameras, points, sigma)
    assert np.isfinite(planned.sd_mm).sum() == 18 * 3
    np.testing.assert_allclose(planned.covariance_mm2, batch.covariance_mm2, rtol=1e-6)
    lost = np.isnan(batch.position_mm[:, 0])
    assert lost.sum() == 1
    np.testing.assert_array_equal(planned.flags[lost], batch.flags[lost])
    np.testing.assert_array_equal(planned.sensors, batch.used.sum(axis=1))


def test_a_reading_that_says_nothing_is_not_counted_as_in_the_reconstruction() -> None:
    cameras = CameraStack.of(rig(4))
    points = control_points(3)
    sigma = np.array([0.05, 0.05, 0.05, 100.0])
    batch = reconstruct(cameras, cameras.project(points), sigma)
    planned = point_precision(cameras, points, sigma)
    assert (planned.sensors == 3).all()
    np.testing.assert_allclose(planned.covariance_mm2, batch.covariance_mm2, rtol=1e-6)


def test_noisy_readings_scatter_as_planned() -> None:
    trials = 4000
    cameras = CameraStack.of(rig(4))
    point = np.array([[120.0, -80.0, 1400.0]])
    rng = np.random.default_rng(5)
    readings = cameras.project(point) + SIGMA * rng.standard_normal((trials, 4))
    error = reconstruct(cameras, readings, SIGMA).position_mm - point
    planned = point_precision(cameras, point, SIGMA)
    # Normalised by the planned covariance the errors are three unit normals: the mean of their
    # squares is 3 +- sqrt(6 / trials); five of these.
    squared = np.einsum("ti,ij,tj->t", error, np.linalg.inv(planned.covariance_mm2[0]), error)
    assert abs(squared.mean() - 3.0) < 5.0 * np.sqrt(6.0 / trials)
    np.testing.assert_allclose(
        error.std(axis=0), planned.sd_mm[0], rtol=5.0 / np.sqrt(2.0 * trials)
    )


@pytest.mark.parametrize("missing", [2, 3, 4])
def test_fewer_than_three_sensors(missing: int) -> None:
    sigma = SIGMA.copy()
    sigma[:missing] = np.nan
    planned = point_precision(CameraStack.of(rig(4)), control_points(2), sigma)
    assert (planned.flags == PointFlag.TOO_FEW_SENSORS).all()
    assert np.isnan(planned.sd_mm).all()
    assert (planned.sensors == 4 - missing).all()


def test_behind_the_lens_nothing_is_seen() -> None:
    planned = point_precision(CameraStack.of(rig(4)), np.array([[0.0, 0.0, -1500.0]]), SIGMA)
    assert planned.flags.tolist() == [PointFlag.TOO_FEW_SENSORS]


@given(
    st.floats(0.0, np.pi), st.integers(3, 5), st.floats(-200.0, 200.0), st.floats(1000.0, 2000.0)
)
@settings(max_examples=40, deadline=None)
def test_planes_that_meet_in_a_line(
    angle: float, sensors: int, away: float, distance: float
) -> None:
    """Sensors on a line along which their slits run: planes that share a direction."""
    target = np.array([0.0, 0.0, 1500.0])
    # All readings are along x: every plane holds the direction of y.
    models = tuple(
        camera(f"s{i}", np.array([200.0 * i - 300.0, 0.0, 0.0]), 0.0, target)
        for i in range(sensors)
    )
    cameras = CameraStack.of(models)
    point = np.array([[away, 300.0 * np.cos(angle), distance]])
    planned = point_precision(cameras, point, np.full(sensors, 0.1))
    assert planned.flags.tolist() == [PointFlag.DEGENERATE]
    assert np.isnan(planned.covariance_mm2).all()


@given(st.floats(0.1, 10.0), st.integers(0, 3))
@settings(max_examples=40, deadline=None)
def test_noise_scales_and_sensors_add(factor: float, dropped: int) -> None:
    points = control_points(4)
    cameras = CameraStack.of(rig(4))
    planned = point_precision(cameras, points, SIGMA)
    scaled = point_precision(cameras, points, factor * SIGMA)
    np.testing.assert_allclose(scaled.sd_mm, factor * planned.sd_mm, rtol=1e-9)
    fewer = SIGMA.copy()
    fewer[dropped] = np.nan
    # Information of one sensor less: no axis gets better.
    assert (point_precision(cameras, points, fewer).sd_mm >= planned.sd_mm * (1 - 1e-12)).all()


def bar_cameras(baseline_mm: float, distance_mm: float) -> CameraStack:
    """Four sensors on a bar, two across it and two along it, aimed straight ahead."""
    half = baseline_mm / 2.0
    models = []
    for name, x, angle in (
        ("left", -half, 0.0),
        ("right", half, 0.0),
        ("up", -half / 2.0, np.pi / 2),
        ("also up", half / 2.0, np.pi / 2),
    ):
        models.append(camera(name, np.array([x, 0.0, 0.0]), angle, np.array([x, 0.0, distance_mm])))
    return CameraStack.of(tuple(models))


def exponent(x: np.ndarray, y: np.ndarray) -> float:
    return float(np.polyfit(np.log(x), np.log(y), 1)[0])


def test_depth_error_grows_with_the_square_of_distance_and_falls_with_the_baseline() -> None:
    """From Z = (c B / p): dZ = Z^2 / (c B) dp while the baseline is short against the distance.

    Near by the law fails: rays that meet at a wide angle no longer weaken with the distance.
    """
    sigma = np.full(4, 0.1)
    distances = np.geomspace(2000.0, 8000.0, 7)
    depth = [
        point_precision(bar_cameras(500.0, z), np.array([[0.0, 0.0, z]]), sigma).sd_mm[0, 2]
        for z in distances
    ]
    assert exponent(distances, np.array(depth)) == pytest.approx(2.0, abs=0.1)
    baselines = np.geomspace(100.0, 800.0, 7)
    depth = [
        point_precision(bar_cameras(b, 4000.0), np.array([[0.0, 0.0, 4000.0]]), sigma).sd_mm[0, 2]
        for b in baselines
    ]
    assert exponent(baselines, np.array(depth)) == pytest.approx(-1.0, abs=0.1)
    # dZ = Z^2 / (c B) times the deviation of a difference of two readings.
    expected = 4000.0**2 / (3000.0 * 800.0) * 0.1 * np.sqrt(2.0)
    assert depth[-1] == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize(
    ("sigma", "message"),
    [
        (np.array([0.1, 0.1, 0.0, 0.1]), "0.0; it must be positive"),
        (np.array([0.1, -0.1, 0.1, 0.1]), "-0.1"),
        (np.array([0.1, 0.1, 0.1]), "shape"),
    ],
)
def test_wrong_deviations_are_refused(sigma: np.ndarray, message: str) -> None:
    with pytest.raises(InvalidParameter, match="sigma_px") as refused:
        point_precision(CameraStack.of(rig(4)), control_points(2), sigma)
    assert message in str(refused.value)


def test_wrong_points_are_refused() -> None:
    with pytest.raises(InvalidParameter, match="points_mm"):
        point_precision(CameraStack.of(rig(4)), np.zeros((2, 2)), SIGMA)


def test_a_sensor_without_a_slope_does_not_see() -> None:
    slopes = CameraStack.of(rig(4)).linearise(control_points(1))[1]
    slopes[0, 2] = np.nan
    assert precision_from_jacobian(slopes, SIGMA).sensors.tolist() == [3]
