"""Robust loss: outliers have no influence, clean readings lose little efficiency."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import quad
from scipy.stats import norm

from compute.calibration.calibrate import calibrate
from compute.calibration.settings import CalibrationSettings
from compute.camera.model import SensorGeometry
from compute.camera.stack import CameraStack
from compute.errors import DegeneratePoints, ImplausibleReadings
from compute.robust_statistics import (
    BIWEIGHT_LIMIT,
    EFFICIENCY_LOSS,
    biweight,
    biweight_loss,
)
from tests.compute.distorted_rig import (
    distorted_rig,
    field_points,
    geometry_with_pitch,
    seen_readings,
)
from tests.compute.rig import control_points, geometry, project, rig
from validation.wand_from_readings.scene import Bar, random_bar

Array = NDArray[np.float64]

ROBUST = CalibrationSettings(loss="robust")


def test_the_loss_of_efficiency() -> None:
    """E[psi^2] / E[psi']^2 by quadrature; psi' by differences."""

    def psi(z: float) -> float:
        return z * float(biweight(np.array(z)))

    def slope(z: float) -> float:
        return (psi(z + 1e-5) - psi(z - 1e-5)) / 2e-5

    square = quad(lambda z: psi(z) ** 2 * norm.pdf(z), -BIWEIGHT_LIMIT, BIWEIGHT_LIMIT)[0]
    gain = quad(lambda z: slope(z) * norm.pdf(z), -BIWEIGHT_LIMIT, BIWEIGHT_LIMIT)[0]
    assert square / gain**2 == pytest.approx(EFFICIENCY_LOSS, abs=1e-4)


def test_weights() -> None:
    assert biweight(np.array([0.0, BIWEIGHT_LIMIT, -9.0])).tolist() == [1.0, 0.0, 0.0]


@pytest.mark.parametrize("known", [True, False])
def test_gross_errors_leave_no_trace(known: bool) -> None:
    models, points = rig(), control_points(30)
    rng = np.random.default_rng(5)
    clean = project(models, points) + 0.2 * rng.standard_normal((30, 4))
    wrong = clean.copy()
    # Also the outermost point, which has the most leverage.
    outer = int(np.linalg.norm(points - points.mean(axis=0), axis=1).argmax())
    for row in (outer, (outer + 7) % 30, (outer + 13) % 30):
        wrong[row, 1] += 25.0
    sigma = np.full(clean.shape, 0.2) if known else None
    found = calibrate(points, wrong, geometry(models), sigma, ROBUST)
    rest = clean.copy()
    rest[~(np.abs(wrong - clean) < 1e-9)] = np.nan
    without = calibrate(points, rest, geometry(models), sigma, ROBUST)
    unseen = control_points(100, seed=9)
    stacks = [CameraStack.of(one.models) for one in (found, without)]
    assert np.abs(stacks[0].project(unseen) - stacks[1].project(unseen)).max() < 0.02
    assert found.reading_weights is not None
    assert found.reading_weights[outer][1] == 0.0
    plain = calibrate(points, wrong, geometry(models), sigma)
    misled = CameraStack.of(plain.models).project(unseen) - stacks[1].project(unseen)
    assert np.abs(misled).max() > 1.0


def test_gross_errors_beside_distortion() -> None:
    models, points = distorted_rig(((1, 2), (3, 0))), field_points(80)
    rng = np.random.default_rng(5)
    clean = seen_readings(models, points) + 0.05 * rng.standard_normal((80, 4))
    clean = np.where((clean > -0.5) & (clean < 2047.5), clean, np.nan)
    wrong = clean.copy()
    wrong[[3, 20, 41], 0] = np.clip(wrong[[3, 20, 41], 0] + [9.0, -30.0, 4.0], 0.0, 2047.0)
    settings = CalibrationSettings(distortion="symmetric-3", loss="robust")
    found = calibrate(points, wrong, geometry_with_pitch(models), None, settings)
    unseen = field_points(100, seed=9)
    error = CameraStack.of(found.models).project(unseen) - seen_readings(models, unseen)
    assert np.sqrt(np.nanmean(error**2)) < 0.05
    assert found.reading_weights is not None
    moved = np.argwhere(np.abs(wrong - clean) > 1.0)
    assert [found.reading_weights[row][column] for row, column in moved] == [0.0] * len(moved)


@pytest.mark.slow
@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize(("points", "seed"), [(19, 3), (30, 4)])
def test_gross_errors_leave_no_trace_where_the_distortion_is_unknown(
    known: bool, points: int, seed: int
) -> None:
    """A lens with 23 parameters could follow two wrong readings of 19."""
    models, places = rig(), control_points(points, seed)
    rng = np.random.default_rng(seed)
    clean = project(models, places) + 0.05 * rng.standard_normal((points, 4))
    wrong = clean.copy()
    wrong[[2, 6], 0] = wrong[[6, 2], 0]
    wrong[4, 1] += 5.0
    sigma = np.full(clean.shape, 0.05) if known else None
    settings = CalibrationSettings(distortion="auto", loss="robust")
    found = calibrate(places, wrong, geometry(models), sigma, settings)
    assert found.reading_weights is not None
    weights = np.array(found.reading_weights)
    changed = wrong != clean
    assert (weights[changed] == 0.0).all()
    assert (weights[~changed] > 0.0).all()
    unseen = control_points(100, seed=9)
    error = CameraStack.of(found.models).project(unseen) - project(models, unseen)
    assert np.sqrt((error**2).mean(axis=0)).max() < 0.2


@pytest.mark.slow
@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("seed", [0, 1, 2, 3])
def test_gross_errors_of_few_readings_beside_distortion(known: bool, seed: int) -> None:
    """Two of about 17 readings are wrong, by more than the lens distorts."""
    models = tuple(
        replace(model, distortion=replace(model.distortion, coefficients=(0.02, 0.02)))
        for model in distorted_rig(((1, 2), (3, 0)), seed)
        if model.distortion is not None
    )
    points = field_points(19, seed + 20)
    rng = np.random.default_rng(seed)
    clean = seen_readings(models, points) + 0.05 * rng.standard_normal((19, 4))
    inside = np.flatnonzero(np.isfinite(clean[:, 0]) & (clean[:, 0] < 1900.0))
    wrong = clean.copy()
    wrong[inside[[1, 7]], 0] += [8.0, 90.0]
    settings = CalibrationSettings(distortion="symmetric-3", loss="robust")
    sigma = np.full(clean.shape, 0.05) if known else None
    found = calibrate(points, wrong, geometry_with_pitch(models), sigma, settings)
    assert found.reading_weights is not None
    assert [found.reading_weights[row][0] for row in inside[[1, 7]]] == [0.0, 0.0]
    unseen = field_points(100, seed=9)
    error = CameraStack.of(found.models).project(unseen) - seen_readings(models, unseen)
    assert np.sqrt(np.nanmean(error[:, 0] ** 2)) < 0.3


@pytest.mark.slow
def test_the_covariance_is_honest() -> None:
    models, points = rig(1), control_points(40)
    exact = project(models, points)
    unseen = control_points(30, seed=9)
    truth = CameraStack.of(models).project(unseen)[:, 0]
    rng, ratios = np.random.default_rng(7), []
    for _ in range(60):
        noisy = exact + 0.3 * rng.standard_normal(exact.shape)
        noisy[rng.choice(40, 3, replace=False), 0] += 40.0
        given = points, noisy, geometry(models), np.full(exact.shape, 0.3), ROBUST
        found = calibrate(*given)
        stack = CameraStack.of(found.models)
        slopes = stack.parameter_jacobian(unseen)[:, 0]
        variance = np.einsum("np,pq,nq->n", slopes, np.array(found.covariance), slopes)
        ratios.append(((stack.project(unseen)[:, 0] - truth) ** 2 / variance).mean())
    error = np.std(ratios) / np.sqrt(len(ratios))
    assert np.mean(ratios) == pytest.approx(1.0, abs=5 * error)
    assert error < 0.12


def test_too_many_gross_errors_are_not_hidden() -> None:
    """Where most readings are wrong nothing can be had, and no small deviation is claimed."""
    models, points = rig(), control_points(12)
    rng = np.random.default_rng(3)
    readings = rng.uniform(100.0, 1900.0, (12, 4))
    try:
        found = calibrate(points, readings, geometry(models), None, ROBUST)
    except (DegeneratePoints, ImplausibleReadings):
        return
    assert max(fit.sigma_px for fit in found.sensors) > 10.0


def test_loss_is_the_integral_of_its_weights() -> None:
    z = np.linspace(0.0, 8.0, 4001)
    integrand = z * biweight(z)
    steps = 0.5 * (integrand[1:] + integrand[:-1]) * np.diff(z)
    integral = np.concatenate([[0.0], np.cumsum(steps)])
    assert biweight_loss(z) == pytest.approx(integral, abs=1e-5)


def _read_a_distorted_bar(seed: int, count: int) -> tuple[Bar, Array, Array]:
    """A bar whose lenses move the light by 40 px at the field's edge, points, exact readings."""
    rng = np.random.default_rng(seed)
    bar = random_bar(rng, 4, distorted=False)
    edge = 0.5 * bar.pixels / bar.distance_px
    share = 40.0 / (0.5 * bar.pixels)
    terms = np.column_stack([share / edge**2, 1.2 * share / edge**2, np.zeros(4)])
    bar = replace(bar, distortion=terms)
    cube = rng.uniform(-0.5, 0.5, (20 * count, 3)) * bar.side_mm
    points = bar.centre_mm + cube
    points = points[np.isfinite(bar.read(points)).all(axis=1)][: count + 100]
    return bar, points, bar.read(points)


@pytest.mark.slow
@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("seed", [11, 12, 13, 14])
def test_gross_errors_of_few_readings_as_large_as_the_distortion(known: bool, seed: int) -> None:
    """Two of 19 readings of each sensor are wrong, by no more than the lens distorts."""
    count, sigma = 19, 0.1
    bar, points, exact = _read_a_distorted_bar(seed, count)
    rng = np.random.default_rng(seed)
    wrong = exact[:count] + sigma * rng.standard_normal((count, 4))
    moved = np.zeros(wrong.shape, dtype=bool)
    for sensor in range(4):
        moved[rng.permutation(count)[:2], sensor] = True
    by = rng.uniform(12.0, 40.0, wrong.shape) * np.where(wrong > 0.5 * bar.pixels, -1.0, 1.0)
    wrong = np.where(moved, wrong + by, wrong)
    sensors = [SensorGeometry(f"s{k}", bar.pixels) for k in range(4)]
    given = np.full(wrong.shape, sigma) if known else None
    settings = CalibrationSettings(distortion="symmetric-3", loss="robust")
    found = calibrate(points[:count], wrong, sensors, given, settings)
    weights = np.array(found.reading_weights)
    assert (weights[moved] == 0.0).all()
    error = CameraStack.of(found.models).project(points[count:]) - exact[count:]
    assert np.sqrt((error**2).mean(axis=0)).max() < 10.0 * sigma
