"""Points from distorted cameras and through correction tables: exact, honest, flagged outside."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from compute.camera.stack import CameraStack
from compute.errors import InvalidParameter
from compute.mapping.table import CorrectionTable, Degree
from compute.measurement.measurement_model import MeasurementModel
from compute.reconstruction.point_batch import PointBatch, PointFlag
from compute.reconstruction.triangulation import (
    detectable_errors,
    reconstruct,
    triangulate_linear,
)
from tests.compute.reconstruction.distorted_rig import GRID, distorted_rig, field_points, table
from tests.compute.reconstruction.matching import match_peaks
from tests.compute.rig import rig

Array = NDArray[np.float64]


def measured(cameras: CameraStack, corrections: CorrectionTable, points: Array) -> Array:
    """What the sensors read of points where the table is right."""
    return cameras.project(points) - corrections.at(points).value_px


def normalised(batch: PointBatch, points: Array) -> Array:
    error = batch.position_mm - points
    return np.asarray(np.einsum("ni,nij,nj->n", error, np.linalg.inv(batch.covariance_mm2), error))


@settings(deadline=None, max_examples=25)
@given(st.integers(3, 7), st.integers(0, 10**6))
def test_exact_readings_of_distorted_cameras_give_the_points(sensors: int, seed: int) -> None:
    models, points = distorted_rig(sensors), field_points(30, seed)
    cameras = CameraStack.of(models)
    batch = reconstruct(cameras, cameras.project(points), np.full(sensors, 0.05))
    assert np.abs(batch.position_mm - points).max() < 1e-9


def test_the_linear_start_is_centimetres_off_and_good_enough() -> None:
    """Ten pixels of distortion move it that far, and all points converge all the same."""
    cameras, points = CameraStack.of(distorted_rig()), field_points(2000, 4, 330.0)
    plain = CameraStack.of([replace(m, distortion=None) for m in distorted_rig()])
    readings = cameras.project(points)
    moved = np.abs(readings - plain.project(points))
    assert moved.max() > 10.0
    start = triangulate_linear(cameras, readings)
    assert np.abs(start - points).max() > 10.0
    batch = reconstruct(cameras, readings, np.full(4, 0.05))
    assert np.abs(batch.position_mm - points).max() < 1e-9


@pytest.mark.parametrize("distorted", [False, True])
@settings(deadline=None, max_examples=15)
@given(st.sampled_from([1, 3]), st.integers(0, 10**6))
def test_exact_readings_through_a_table_give_the_points(
    distorted: bool, degree: Degree, seed: int
) -> None:
    cameras = CameraStack.of(distorted_rig() if distorted else rig())
    corrections, points = table(degree, seed=seed), field_points(30, seed)
    readings = measured(cameras, corrections, points)
    batch = reconstruct(cameras, readings, np.full(4, 0.05), corrections=corrections)
    assert np.abs(batch.position_mm - points).max() < 1e-9
    assert not (batch.flags & PointFlag.OUTSIDE_MAP).any()


def test_reading_correcting_and_solving_in_turn_ends_there() -> None:
    """With three sensors, where there is nothing to weigh."""
    cameras, corrections, points = CameraStack.of(rig(3)), table(3, 3), field_points(20, 8)
    rng = np.random.default_rng(2)
    readings = measured(cameras, corrections, points) + 0.05 * rng.standard_normal((20, 3))
    sigma = np.full(3, 0.05)
    found = reconstruct(cameras, readings, sigma, corrections=corrections).position_mm
    turned = reconstruct(cameras, readings, sigma).position_mm
    assert np.abs(turned - found).max() > 10.0
    for _ in range(25):
        corrected = readings + corrections.at(turned).value_px
        turned = reconstruct(cameras, corrected, sigma).position_mm
    assert np.abs(turned - found).max() < 1e-7


def test_a_cubic_term_takes_corrected_readings() -> None:
    cubic = CameraStack.of([replace(model, cubic_per_px2=2e-8) for model in rig()])
    corrections, points = table(3), field_points(10, 6)
    camera_reads = cubic.project(points)
    # Newton's method for the reading whose correction by [5.12] it is.
    readings = camera_reads.copy()
    for _ in range(20):
        readings -= (cubic.add_cubic_term(readings) - camera_reads) / cubic.correction_derivative(
            readings
        )
    readings -= corrections.at(points).value_px
    batch = reconstruct(cubic, readings, np.full(4, 0.05), corrections=corrections)
    assert np.abs(batch.position_mm - points).max() < 1e-9


@pytest.mark.slow
@pytest.mark.parametrize("degree", [None, 1, 3])
@pytest.mark.parametrize("sensors", [3, 4])
def test_covariance_is_honest(degree: Degree | None, sensors: int) -> None:
    """Normalised squared errors average 3: noise, the cameras' errors, and the table's."""
    models, sigma, count = distorted_rig(sensors), 0.1, 3000
    cameras, points = CameraStack.of(models), field_points(count, 5)
    rng = np.random.default_rng(6)
    width = sum(model.parameter_count for model in models)
    scale = np.concatenate([_deviations(model.parameter_count) for model in models])
    mixing = np.eye(width) + 0.3 * rng.standard_normal((width, width)) / np.sqrt(width)
    factor = scale[:, None] * mixing
    readings = cameras.project(points) + sigma * rng.standard_normal((count, sensors))
    # Each point has cameras of its own: to first order, their errors are those of the readings.
    steps = factor @ rng.standard_normal((width, count))
    slopes = cameras.parameter_jacobian(points)
    for sensor in range(sensors):
        own = cameras.parameter_mask[sensor]
        step = steps[cameras.parameter_index[sensor][own]]
        readings[:, sensor] += np.einsum("nw,wn->n", slopes[:, sensor][:, own], step)
    corrections = None if degree is None else table(degree, sensors)
    if corrections is not None:
        there = corrections.at(points)
        readings -= there.value_px
        readings += np.sqrt(there.variance_px2) * rng.standard_normal((count, sensors))
    batch = reconstruct(models, readings, np.full(sensors, sigma), factor @ factor.T, corrections)
    squares = normalised(batch, points)
    assert squares.mean() == pytest.approx(3.0, abs=5 * np.sqrt(6 / count))
    if sensors > 3:
        assert batch.chi2.mean() == pytest.approx(1.0, abs=5 * np.sqrt(2 / count))
    # Each of the three shares counts.
    fewer = [reconstruct(models, readings, np.full(sensors, sigma), None, corrections)]
    if corrections is not None:
        sure = replace(corrections, variance_px2=np.zeros_like(corrections.variance_px2))
        fewer.append(
            reconstruct(models, readings, np.full(sensors, sigma), factor @ factor.T, sure)
        )
    for less in fewer:
        assert normalised(less, points).mean() > 3.0 + 5 * np.sqrt(6 / count)


def _deviations(parameters: int) -> Array:
    scale = np.array([0.2, 0.1, 3e-5, 3e-5, 3e-5, 0.03, 0.03])
    further = np.concatenate([[0.1], np.full(max(parameters - 8, 0), 3e-4)])
    return np.concatenate([scale, further])[:parameters]


def test_weights_are_those_of_the_place_and_not_of_the_linear_start() -> None:
    """The table's variance differs threefold between nodes; the linear start is in other cells."""
    cameras, corrections = CameraStack.of(rig(3)), table(1, 3)
    points = field_points(300, 7)
    readings = measured(cameras, corrections, points)
    batch = reconstruct(cameras, readings, np.full(3, 0.05), corrections=corrections)
    # With three sensors the covariance is that of the equations at the point itself.
    _, slope = cameras.linearise(points)
    there = corrections.at(points)
    inverse = np.linalg.inv(slope - there.gradient_px_per_mm)
    noise = 0.05**2 + there.variance_px2
    expected = np.einsum("nis,ns,njs->nij", inverse, noise, inverse)
    assert np.allclose(batch.covariance_mm2, expected, rtol=0.01)
    # What the weights of the linear start would give.
    start = triangulate_linear(cameras, readings)
    there = corrections.at(start)
    from_start = np.einsum("nis,ns,njs->nij", inverse, 0.05**2 + there.variance_px2, inverse)
    assert not np.allclose(from_start, expected, rtol=0.1)


def test_outside_the_map_is_flagged_by_the_sensors_used() -> None:
    cameras, corrections = CameraStack.of(rig()), table(3)
    valid = corrections.valid.copy()
    valid[2, 5, 5, 5] = False
    corrections = replace(corrections, valid=valid)
    middle = np.asarray(GRID.origin_mm) + 5.5 * np.asarray(GRID.pitch_mm)
    beyond = np.array([0.0, 0.0, GRID.origin_mm[2] - 20.0])
    points = np.array([middle, beyond, [0.0, 0.0, 1400.0], middle])
    readings = measured(cameras, corrections, points)
    readings[3, 2] = np.nan
    batch = reconstruct(cameras, readings, np.full(4, 0.05), corrections=corrections)
    outside = batch.flags & PointFlag.OUTSIDE_MAP > 0
    assert outside.tolist() == [True, True, False, False]
    assert np.abs(batch.position_mm - points).max() < 1e-9
    # Beyond the box nothing says how certain it is.
    unknown = batch.flags & PointFlag.NO_COVARIANCE > 0
    assert unknown.tolist() == [False, True, False, False]
    published = batch.published()
    assert np.isnan(published.covariance_mm2[:, 0, 0]).tolist() == unknown.tolist()
    assert np.isnan(published.external_reliability_mm).tolist() == unknown.tolist()
    assert np.isfinite(batch.covariance_mm2).all()
    estimates = batch.estimates(corrections.sensors)
    assert [one.covariance_mm2 is None for one in estimates] == unknown.tolist()
    assert all(one.position_mm is not None for one in estimates)
    sigma = np.full(readings.shape, 0.05)
    model = MeasurementModel.of(cameras, None, corrections)
    detectable = detectable_errors(model, batch, readings, sigma)
    assert np.isnan(detectable).all(axis=1).tolist() == unknown.tolist()
    assert "outside-map" in batch.estimates(corrections.sensors)[0].flags


def test_points_that_are_not_there_are_not_outside_the_map() -> None:
    readings = np.full((1, 4), np.nan)
    batch = reconstruct(rig(), readings, np.ones(4), corrections=table(3))
    assert batch.flags[0] == PointFlag.TOO_FEW_SENSORS


def test_markers_are_told_apart_through_the_table() -> None:
    cameras, corrections, points = CameraStack.of(rig()), table(3), field_points(3, 11)
    readings = measured(cameras, corrections, points)
    position, sigma = np.sort(readings.T, axis=1), np.full((4, 3), 0.02)
    found = match_peaks(cameras, position, sigma, corrections=corrections)
    assert len(found.readings_px) == 3
    for row in found.readings_px:
        assert np.abs(readings - row).max(axis=1).min() == 0.0
    without = match_peaks(cameras, position, sigma)
    right = [np.abs(readings - row).max(axis=1).min() == 0.0 for row in without.readings_px]
    assert sum(right) < 3


def test_a_table_of_other_sensors_is_refused() -> None:
    with pytest.raises(InvalidParameter, match="of 3 sensors; there are 4 cameras"):
        reconstruct(rig(), np.ones((1, 4)), np.ones(4), corrections=table(1, 3))
