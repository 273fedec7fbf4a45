"""The measurement model against an own projection in 50 digits and its numerical derivatives."""

from dataclasses import replace
from decimal import Decimal, getcontext

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from compute.camera.model import SensorModel
from compute.camera.stack import CameraStack
from compute.mapping.grid import VoxelGrid
from compute.mapping.table import CorrectionTable
from compute.measurement.measurement_model import MeasurementModel, invert_cubic
from tests.compute.distorted_rig import distorted_rig
from tests.compute.rig import control_points, rig

Array = NDArray[np.float64]

getcontext().prec = 50
CUBIC = 3e-9
PITCH_MM, CELLS, ORIGIN_MM = 100.0, 6, (-300.0, -300.0, 1200.0)


def table() -> CorrectionTable:
    """Trilinear corrections of some pixels: the oracle interpolates them by itself."""
    rng = np.random.default_rng(4)
    nodes = (4, CELLS + 1, CELLS + 1, CELLS + 1)
    return CorrectionTable(
        tuple(f"s{n}" for n in range(4)),
        "0" * 64,
        VoxelGrid(ORIGIN_MM, (PITCH_MM,) * 3, (CELLS,) * 3),
        1,
        2.0 * rng.standard_normal(nodes),
        rng.uniform(0.001, 0.01, nodes),
        np.ones((4, CELLS, CELLS, CELLS), dtype=np.bool_),
    )


def models(kind: str) -> list[SensorModel]:
    own = list(distorted_rig(((2, 1), (0, 3), (3, 0)))) if "terms" in kind else list(rig())
    cubic = {"plus": CUBIC, "minus": -CUBIC}.get(kind.split("-")[0], 0.0)
    return [replace(model, cubic_per_px2=cubic) for model in own]


def trigonometric(angle: Decimal, first: int) -> Decimal:
    """Return the cosine (first 0) or sine (first 1) by its series."""
    term = angle if first else Decimal(1)
    total = Decimal(0)
    for n in range(first, 60, 2):
        total += term
        term = -term * angle * angle / ((n + 1) * (n + 2))
    return total


def cubic_root(wanted: Decimal, p0: Decimal, cubic: Decimal) -> Decimal:
    """Solve q + D (q - p0)^3 = wanted by Newton from the middle."""
    reading = p0
    for _ in range(40):
        misfit = reading + cubic * (reading - p0) ** 3 - wanted
        reading -= misfit / (1 + 3 * cubic * (reading - p0) ** 2)
    return reading


def corrected_reading(model: SensorModel, point: list[Decimal]) -> Decimal:
    """Project by the textbook: rotate by Rodrigues, divide by the depth, add the terms."""
    w = [Decimal(x) for x in model.rotation_vector_rad]
    angle = sum((x * x for x in w), Decimal(0)).sqrt()
    axis = [x / angle for x in w] if angle else [Decimal(1), Decimal(0), Decimal(0)]
    dot = sum(a * x for a, x in zip(axis, point, strict=True))
    cross = [
        axis[1] * point[2] - axis[2] * point[1],
        axis[2] * point[0] - axis[0] * point[2],
        axis[0] * point[1] - axis[1] * point[0],
    ]
    turned = [
        x * trigonometric(angle, 0)
        + c * trigonometric(angle, 1)
        + a * dot * (1 - trigonometric(angle, 0))
        for x, c, a in zip(point, cross, axis, strict=True)
    ]
    depth = turned[2] + Decimal(model.offset_z_mm)
    u = (turned[0] + Decimal(model.offset_x_mm)) / depth
    value = u
    if model.distortion is not None:
        v = (turned[1] + Decimal(model.distortion.offset_y_mm)) / (
            depth + Decimal(model.distortion.row_behind_mm)
        )
        for (i, j), a in zip(model.distortion.terms, model.distortion.coefficients, strict=True):
            value += Decimal(a) * u**i * v**j
    return Decimal(model.principal_point_px) + Decimal(model.principal_distance_px) * value


def raw_reading(
    model: SensorModel, sensor: int, point: list[Decimal], corrections: CorrectionTable | None
) -> Decimal:
    """Undo the cubic by Newton in 50 digits, then subtract the table's correction."""
    wanted, p0 = corrected_reading(model, point), Decimal(model.principal_point_px)
    cubic = Decimal(model.cubic_per_px2)
    reading = cubic_root(wanted, p0, cubic)
    if corrections is None:
        return reading
    at = [(x - Decimal(o)) / Decimal(PITCH_MM) for x, o in zip(point, ORIGIN_MM, strict=True)]
    cell = [min(max(int(x // 1), 0), CELLS - 1) for x in at]
    total = Decimal(0)
    for corner in np.ndindex(2, 2, 2):
        weight = Decimal(1)
        for x, c, one in zip(at, cell, corner, strict=True):
            weight *= (x - c) if one else 1 - (x - c)
        index = tuple(c + one for c, one in zip(cell, corner, strict=True))
        total += weight * Decimal(corrections.coefficients_px[(sensor, *index)])
    return reading - total


@pytest.mark.parametrize("mapped", [False, True])
@pytest.mark.parametrize("kind", ["plain", "plus", "minus", "terms", "plus-terms"])
def test_prediction_and_jacobian_are_those_of_the_oracle(kind: str, mapped: bool) -> None:
    cameras, corrections = models(kind), table() if mapped else None
    points = control_points(6, seed=8)
    model = MeasurementModel(CameraStack.of(cameras), None, corrections)
    predicted = model.predict(points)
    reading, jacobian = model.linearise(points)
    assert (reading == predicted.reading_px).all()
    assert (jacobian == predicted.jacobian_px_per_mm).all()
    step = Decimal(10) ** -20
    for n, point in enumerate(points):
        place = [Decimal(float(x)) for x in point]
        for sensor, camera in enumerate(cameras):
            value = raw_reading(camera, sensor, place, corrections)
            assert abs(Decimal(float(predicted.reading_px[n, sensor])) - value) < Decimal("5e-12")
            for axis in range(3):
                moved = [x + (step if a == axis else 0) for a, x in enumerate(place)]
                slope = (raw_reading(camera, sensor, moved, corrections) - value) / step
                assert abs(
                    Decimal(float(predicted.jacobian_px_per_mm[n, sensor, axis])) - slope
                ) < Decimal("1e-11")


@settings(deadline=None, max_examples=200)
@given(
    st.floats(-5000.0, 5000.0),
    st.sampled_from([0.0, 1e-12, -1e-12, 3e-9, -3e-9, 1e-8]),
    st.floats(0.0, 4096.0),
)
def test_inverse_of_the_cubic_is_right_to_the_last_digits(
    offset: float, cubic: float, p0: float
) -> None:
    if cubic < 0.0 and abs(offset) > 0.9 / np.sqrt(-3.0 * cubic):
        return
    true = Decimal(p0) + Decimal(offset)
    wanted = float(true + Decimal(cubic) * Decimal(offset) ** 3)
    found = float(invert_cubic(np.array([wanted]), np.array([p0]), np.array([cubic]))[0])
    # The root of the rounded right side; the slope carries the rounding of p over to q. Distances
    # from p0 may be longer than readings, and are rounded by their own length.
    root = cubic_root(Decimal(wanted), Decimal(p0), Decimal(cubic))
    scale = max(abs(found), abs(wanted), p0, abs(found - p0), abs(wanted - p0), 1e-300)
    slope = float(1 + 3 * Decimal(cubic) * (root - Decimal(p0)) ** 2)
    assert abs(float(Decimal(found) - root)) <= 2.0 * np.spacing(scale) / min(slope, 1.0)


def test_no_reading_corrects_to_what_lies_beyond_the_fold() -> None:
    fold = 1.0 / np.sqrt(3.0 * CUBIC)
    p0, cubic = np.array([1000.0]), np.array([-CUBIC])
    limit = 1000.0 + 2.0 / 3.0 * fold
    inside = invert_cubic(np.array([limit - 1e-6]), p0, cubic)
    assert abs(inside[0] - 1000.0 - fold) < 0.2
    assert np.isnan(invert_cubic(np.array([limit + 1.0]), p0, cubic)).all()
    assert np.isnan(invert_cubic(np.array([np.nan]), p0, cubic)).all()


@pytest.mark.parametrize("kind", ["plain", "plus", "plus-terms"])
def test_common_errors_are_those_of_the_covariance(kind: str) -> None:
    """G G' is the readings' covariance by finite differences of the parameters."""
    cameras = CameraStack.of(models(kind))
    rng = np.random.default_rng(2)
    count = int(cameras.parameter_mask.sum())
    root = 1e-4 * rng.standard_normal((count, count))
    covariance = root @ root.T
    points = control_points(3, seed=1)
    model = MeasurementModel(cameras, covariance)
    predicted = model.predict(points, with_common_errors=True)
    jacobian = np.zeros((3, 4, count))
    for sensor, column in np.argwhere(cameras.parameter_mask):
        step = np.zeros(cameras.parameter_mask.shape)
        step[sensor, column] = 1e-6
        more = MeasurementModel(cameras.retract(step)).linearise(points)[0]
        less = MeasurementModel(cameras.retract(-step)).linearise(points)[0]
        jacobian[..., cameras.parameter_index[sensor, column]] = (more - less) / 2e-6
    wanted = np.einsum("nsp,pq,ntq->nst", jacobian, covariance, jacobian)
    common = predicted.common_jacobian_px
    scale = np.abs(wanted).max()
    assert np.allclose(common @ common.transpose(0, 2, 1), wanted, rtol=1e-4, atol=1e-6 * scale)
    systematic = model.systematic_covariance(points)
    assert np.allclose(systematic, wanted, rtol=1e-4, atol=1e-6 * scale)
    variance = np.diagonal(systematic, axis1=1, axis2=2)
    assert np.allclose(model.calibration_variance(points), variance, rtol=1e-9)


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 1000), st.sampled_from(["plus", "minus", "plus-terms"]), st.booleans())
def test_both_forms_of_the_model_agree(seed: int, kind: str, mapped: bool) -> None:
    """Residuals in corrected pixels are raw ones times d corrected / d reading."""
    cameras = CameraStack.of(models(kind))
    model = MeasurementModel(cameras, None, table() if mapped else None)
    points = control_points(4, seed=seed)
    reading, jacobian = model.linearise(points)
    residual, slope = model.residuals(reading, points)
    assert np.abs(residual).max() < 1e-9
    correction = 0.0 if model.corrections is None else model.corrections.at(points).value_px
    derivative = cameras.correction_derivative(reading + correction)
    assert np.allclose(slope, jacobian * derivative[..., None], rtol=1e-9, atol=1e-12)


def test_hull_view_and_table_variance() -> None:
    corrections = table()
    model = MeasurementModel(CameraStack.of(rig()), None, corrections, (2048,) * 4)
    points = np.array([[0.0, 0.0, 1500.0], [0.0, 0.0, 2500.0], [0.0, 0.0, -900.0]])
    predicted = model.predict(points)
    assert predicted.inside_hull.all(axis=1).tolist() == [True, False, False]
    assert (model.inside_hull(points) == predicted.inside_hull).all()
    assert predicted.in_view[0].all()
    assert not predicted.in_view[2].any()
    assert (predicted.table_variance_px2 >= 0.0).all()
    part = predicted.part(1, 2)
    assert (part.reading_px == predicted.reading_px[1:2]).all()
