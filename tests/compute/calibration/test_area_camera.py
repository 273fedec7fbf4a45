"""Two-dimensional cameras: a pair of linear sensors that share one rotation and one centre."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.linalg import block_diag

from compute.calibration.area_camera import calibrate_planar
from compute.calibration.calibrate import calibrate
from compute.camera.area_camera import (
    PlanarCamera,
    dlt_constraints,
    dlt_eleven_parameters,
    normal_case,
)
from compute.camera.rotation import rotation_matrix
from compute.camera.stack import CameraStack
from compute.errors import DegeneratePoints, InvalidParameter, NoConvergence
from compute.reconstruction.triangulation import reconstruct
from tests.compute.rig import control_points, geometry, project, rig

Array = NDArray[np.float64]

SIZE = (1600, 1250)
CAMERA = PlanarCamera(
    "cam",
    SIZE,
    (2000.0, 2000.0),
    (810.0, 640.0),
    (0.1, -0.15, 0.3),
    (20.0, -30.0, 100.0),
    (0.08, -0.05),
    (0.002, -0.001),
)
PLAIN = replace(CAMERA, radial=(), decentring=())


def directly(camera: PlanarCamera, points: Array) -> Array:
    """[2.7] with [2.12] and [2.14], written out."""
    rotation = rotation_matrix(np.array(camera.rotation_vector_rad))
    x, y, z = (points @ rotation.T + camera.offset_mm).T
    u, v = x / z, y / z
    r2 = u**2 + v**2
    stretch = sum(k * r2 ** (n + 1) for n, k in enumerate(camera.radial))
    p1, p2 = camera.decentring or (0.0, 0.0)
    du = u * stretch + p1 * (r2 + 2 * u**2) + 2 * p2 * u * v
    dv = v * stretch + p2 * (r2 + 2 * v**2) + 2 * p1 * u * v
    (cx, cy), (px, py) = camera.principal_distance_px, camera.principal_point_px
    return np.column_stack([px + cx * (u + du), py + cy * (v + dv)])


@pytest.mark.parametrize("camera", [CAMERA, PLAIN, replace(CAMERA, radial=(0.1, 0.0, 0.2))])
def test_the_pair_of_sensors_reads_what_the_camera_does(camera: PlanarCamera) -> None:
    points = control_points(50)
    pair = CameraStack.of(camera.sensors()).project(points)
    assert np.allclose(pair, directly(camera, points), atol=1e-9)


@given(st.integers(0, 2**32 - 1), st.booleans())
def test_slopes_of_the_sensors_parameters(seed: int, square: bool) -> None:
    """What a small step of the camera does to readings, by the chain over both sensors."""
    rng = np.random.default_rng(seed)
    chain = CAMERA.sensor_jacobian(square)
    scale = np.array([*[10.0] * (chain.shape[1] - 12), 10, 10, *[0.01] * 3, *[3] * 3, *[0.01] * 4])
    step = rng.uniform(-1.0, 1.0, chain.shape[1]) * scale[-chain.shape[1] :]
    points = control_points(8)
    ahead, behind = (directly(CAMERA.retract(h * step, square), points) for h in (1e-5, -1e-5))
    slopes = CameraStack.of(CAMERA.sensors())
    jacobian, places = slopes.parameter_jacobian(points), slopes.parameter_index
    change = chain @ step
    exact = np.zeros((8, 2))
    for sensor in range(2):
        own = places[sensor] >= 0
        exact[:, sensor] = jacobian[:, sensor, own] @ change[places[sensor, own]]
    assert np.allclose(exact, (ahead - behind) / 2e-5, rtol=1e-5, atol=1e-3)


def test_the_constraints_hold_of_a_camera_and_not_of_any_eleven() -> None:
    square, right = dlt_constraints(dlt_eleven_parameters(PLAIN))
    assert abs(square) < 1e-6 * 2000.0**2
    assert abs(right) < 1e-6 * 2000.0**2
    oblong = replace(PLAIN, principal_distance_px=(2000.0, 2100.0))
    square, right = dlt_constraints(dlt_eleven_parameters(oblong))
    assert square == pytest.approx(2000.0**2 - 2100.0**2)
    assert abs(right) < 1.0
    skew = dlt_eleven_parameters(PLAIN)
    skew[4] += 0.5
    assert abs(dlt_constraints(skew)[1]) > 1e3
    # And [2.9] is the camera.
    points = control_points(5)
    values = dlt_eleven_parameters(PLAIN)
    depth = points @ values[8:] + 1.0
    read = np.column_stack(
        [(points @ values[:3] + values[3]) / depth, (points @ values[4:7] + values[7]) / depth]
    )
    assert np.allclose(read, directly(PLAIN, points), atol=1e-8)
    with pytest.raises(InvalidParameter, match="depth 0"):
        dlt_eleven_parameters(replace(PLAIN, offset_mm=(1.0, 2.0, 0.0)))


def test_normal_case() -> None:
    points = control_points(20)
    first = 1800.0 * points[:, :2] / points[:, 2:]
    second = 1800.0 * (points - [120.0, 0.0, 0.0])[:, :2] / points[:, 2:]
    assert np.allclose(normal_case(first, second, 120.0, 1800.0), points, atol=1e-8)
    assert np.isnan(normal_case(second, first, 120.0, 1800.0)).all()


def test_exact_readings_give_the_camera_back() -> None:
    points = control_points(40)
    found = calibrate_planar(
        points, directly(CAMERA, points), "cam", SIZE, radial=2, decentring=True
    )
    assert found.camera.principal_distance_px == pytest.approx((2000.0, 2000.0), abs=1e-3)
    assert found.camera.radial == pytest.approx(CAMERA.radial, abs=1e-4)
    assert found.camera.decentring == pytest.approx(CAMERA.decentring, abs=1e-6)
    assert found.camera.square
    assert np.abs(found.residuals_px).max() < 1e-6


def test_the_covariance_is_honest_and_constraints_make_it_small() -> None:
    points, sigma = control_points(30), 0.2
    unseen = control_points(20, seed=8)
    truth = directly(PLAIN, unseen)
    rng, ratios, gains = np.random.default_rng(2), [], []
    for _ in range(60):
        noisy = directly(PLAIN, points) + sigma * rng.standard_normal((30, 2))
        given = np.full((30, 2), sigma)
        found = calibrate_planar(points, noisy, "cam", SIZE, given)
        stack = CameraStack.of(found.models)
        slopes = stack.parameter_jacobian(unseen)
        blocks = stack.covariance_blocks(found.sensor_covariance)
        variance = np.einsum("nsp,spsq,nsq->ns", slopes, blocks, slopes)
        ratios.append(((stack.project(unseen) - truth) ** 2 / variance).mean())
        alone = calibrate(points, noisy, geometry(PLAIN.sensors()), given)  # type: ignore[arg-type]
        free = CameraStack.of(alone.models)
        gains.append(((free.project(unseen) - truth) ** 2).sum() / (variance.sum()))
    error = np.std(ratios) / np.sqrt(len(ratios))
    assert np.mean(ratios) == pytest.approx(1.0, abs=5 * error)
    assert error < 0.12
    # Fourteen parameters against nine.
    assert np.mean(gains) > 1.2


@pytest.mark.parametrize(
    ("count", "radial", "source"), [(7, 2, "assumed"), (7, 3, "assumed"), (9, 2, "residuals")]
)
def test_little_redundancy_is_not_taken_for_certainty(count: int, radial: int, source: str) -> None:
    """Readings to whole pixels, 1, 0 and 5 more than parameters, without their deviations."""
    ratios = []
    for seed in range(30):
        points = np.random.default_rng(seed).uniform(-1.0, 1.0, (count, 3)) * [400, 300, 250]
        points[:, 2] += 1500.0
        exact = directly(CAMERA, points)
        large = (4000, 4000)
        try:
            found = calibrate_planar(
                points, np.round(exact) + 1000.0, "cam", large, radial=radial, decentring=True
            )
        except (NoConvergence, DegeneratePoints, InvalidParameter):
            continue  # so few points may leave no camera to start from
        assert found.sigma_source == source
        stack = CameraStack.of(found.models)
        slopes = stack.parameter_jacobian(points)
        blocks = stack.covariance_blocks(found.sensor_covariance)
        variance = np.einsum("nsp,spsq,nsq->ns", slopes, blocks, slopes)
        ratios.append(((stack.project(points) - exact - 1000.0) ** 2 / variance).mean())
    assert len(ratios) > 8
    # Taken from one residual, the variance was millions of times too small in the worst of them.
    assert 0.5 < np.median(ratios) < 1.5
    assert np.max(ratios) < (2.0 if source == "assumed" else 20.0)


def test_a_rig_may_mix_both_kinds() -> None:
    """Two linear sensors and one camera: four readings of a point, and its covariance."""
    linear, points = rig(2), control_points(30)
    camera = replace(PLAIN, offset_mm=(20.0, -30.0, 100.0))
    rng = np.random.default_rng(0)
    sigma = 0.1
    read = np.hstack([project(linear, points), directly(camera, points)])
    noisy = read + sigma * rng.standard_normal(read.shape)
    given = np.full((30, 2), sigma)
    one = calibrate(points, noisy[:, :2], geometry(linear), given)
    two = calibrate_planar(points, noisy[:, 2:], "cam", SIZE, given)
    unseen = control_points(200, seed=3)
    exact = np.hstack([project(linear, unseen), directly(camera, unseen)])
    found = reconstruct(
        (*one.models, *two.models),
        exact + sigma * rng.standard_normal(exact.shape),
        np.full(4, sigma),
        block_diag(np.array(one.covariance), two.sensor_covariance),
    )
    error = found.position_mm - unseen
    squares = np.einsum("ni,nij,nj->n", error, np.linalg.inv(found.covariance_mm2), error)
    assert np.abs(error).max() < 3.0
    # One calibration for all the points: its error is common to them.
    assert 1.5 < squares.mean() < 6.0


def test_what_is_refused() -> None:
    points = control_points(40)
    readings = directly(PLAIN, points)
    with pytest.raises(InvalidParameter, match="left-handed"):
        calibrate_planar(points, readings[:, ::-1], "cam", SIZE[::-1])
    with pytest.raises(InvalidParameter, match="radial is 4"):
        calibrate_planar(points, readings, "cam", SIZE, radial=4)
    flat = points * [1.0, 1.0, 0.0] + [0.0, 0.0, 1500.0]
    with pytest.raises(DegeneratePoints, match="one plane"):
        calibrate_planar(flat, directly(PLAIN, flat), "cam", SIZE)
    with pytest.raises(InvalidParameter, match="none or 2"):
        replace(PLAIN, decentring=(0.1,))
