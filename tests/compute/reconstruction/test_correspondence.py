"""Peaks of several markers at once: grouped rightly, or not at all."""

from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from compute.camera.stack import CameraStack
from compute.errors import InvalidParameter
from compute.measurement.measurements import Measurements
from compute.reconstruction.correspondence.candidates import MatchSettings
from compute.reconstruction.correspondence.grouping import Correspondence, group_peaks
from compute.reconstruction.correspondence.intersections import covering_triples
from compute.reconstruction.correspondence.predicted_candidates import PredictedPoints
from compute.reconstruction.point_batch import PointBatch
from compute.reconstruction.triangulation import reconstruct
from tests.compute.reconstruction.matching import match_peaks
from tests.compute.reconstruction.peak_scene import random_scene
from tests.compute.rig import control_points, project, rig

Array = NDArray[np.float64]


def peaks(readings: Array, seed: int = 0, sigma: float = 0.02) -> tuple[Array, Array]:
    """Readings (M, S) as the sensors give them: shuffled, noisy, padded with NaN; (S, K)."""
    rng = np.random.default_rng(seed)
    noisy = readings + sigma * rng.standard_normal(readings.shape)
    position = np.full((readings.shape[1], len(readings) + 2), np.nan)
    for sensor, column in enumerate(noisy.T):
        seen = np.sort(column[np.isfinite(column)])
        position[sensor, : len(seen)] = seen
    return position, np.where(np.isfinite(position), sigma, np.nan)


def match(sensors: int, readings: Array, seed: int = 0) -> Correspondence:
    return match_peaks(CameraStack.of(rig(sensors)), *peaks(readings, seed))


@pytest.mark.parametrize("markers", [1, 2, 4])
@pytest.mark.parametrize("sensors", [4, 5])
def test_groups_are_right_or_marked_as_ambiguous(markers: int, sensors: int) -> None:
    unmarked = 0
    for seed in range(20):
        points = control_points(markers, seed=seed)
        readings = project(rig(sensors), points)
        found = match(sensors, readings, seed)
        for row, ambiguous in zip(found.readings_px, found.ambiguous, strict=True):
            right = np.abs(readings - row).max(axis=1).min() < 0.2
            assert right or ambiguous
            unmarked += right and not ambiguous
    # Ghosts that fit by chance are rare at this noise: nearly all groups stand.
    assert unmarked >= 0.8 * 20 * markers


def test_two_markers_on_three_sensors_are_not_guessed() -> None:
    """N markers on three sensors make N^3 points, each of which fits exactly."""
    found = match(3, project(rig(3), control_points(2)))
    assert len(found.readings_px) == 0


def test_one_marker_on_three_sensors_is_a_point() -> None:
    readings = project(rig(3), control_points(1))
    found = match(3, readings)
    assert np.abs(found.readings_px - readings).max() < 0.2
    assert not found.ambiguous[0]


def test_one_marker_that_a_sensor_does_not_see() -> None:
    readings = project(rig(4), control_points(1))
    readings[0, 2] = np.nan
    found = match(4, readings)
    assert len(found.readings_px) == 1
    assert np.isnan(found.readings_px[0, 2])
    assert np.nanmax(np.abs(found.readings_px - readings)) < 0.2


def test_a_reflection_on_one_sensor_is_left_out() -> None:
    readings = project(rig(4), control_points(1))
    position, sigma = peaks(readings)
    position[1, 1], sigma[1, 1] = readings[0, 1] + 150.0, 0.02
    found = match_peaks(CameraStack.of(rig(4)), position, sigma)
    assert len(found.readings_px) == 1
    assert np.abs(found.readings_px - readings).max() < 0.2


def test_four_single_peaks_that_do_not_meet_are_still_reported() -> None:
    """The residual of the point, not the grouping, says that one of them is wrong."""
    readings = project(rig(4), control_points(1))
    readings[0, 1] += 40.0
    assert len(match(4, readings).readings_px) == 1


@pytest.mark.slow
def test_doubt_grows_with_what_is_missing() -> None:
    """Five markers; when a fifth of their lines is missed, wrong combinations fit now and then."""
    rng = np.random.default_rng(4)
    marked = {}
    wrong_unmarked = unmarked = 0
    for missing in (0.0, 0.2):
        flags: list[bool] = []
        for seed in range(30):
            readings = project(rig(4), control_points(5, seed=seed))
            readings[rng.random(readings.shape) < missing] = np.nan
            found = match(4, readings, seed)
            for row, ambiguous in zip(found.readings_px, found.ambiguous, strict=True):
                difference = np.where(np.isnan(readings - row), 1e9, np.abs(readings - row))
                right = difference.max(axis=1).min() < 0.2
                wrong_unmarked += not right and not ambiguous
                unmarked += not ambiguous
                if right:
                    flags.append(bool(ambiguous))
        marked[missing] = np.mean(flags)
    assert wrong_unmarked < 0.01 * unmarked
    assert marked[0.0] < 0.35
    assert marked[0.2] > 0.4


def test_markers_in_one_plane_of_a_sensor_may_have_exchanged_peaks() -> None:
    """Shifted along a sensor's slit, two markers read alike there: which peak is whose?"""
    models = rig(4)
    first = np.array([20.0, 10.0, 1500.0])
    second = first + 60.0 * models[1].rotation[1]
    readings = project(models, np.array([first, second]))
    readings[1, 1] += 0.03
    found = match(4, readings)
    assert len(found.readings_px) == 2
    assert found.ambiguous.all()
    apart = project(models, np.array([first, first + np.array([70.0, 40.0, 25.0])]))
    assert not match(4, apart).ambiguous.any()


def test_a_sensor_that_contradicts_the_other_three_is_not_passed_over() -> None:
    """Two peaks on the fourth sensor, neither where the marker would be."""
    readings = project(rig(4), control_points(1))
    position, sigma = peaks(readings)
    position[3, :2], sigma[3, :2] = readings[0, 3] + np.array([40.0, 90.0]), 0.02
    assert len(match_peaks(CameraStack.of(rig(4)), position, sigma).readings_px) == 0


def test_nothing_seen() -> None:
    found = match_peaks(CameraStack.of(rig(4)), np.full((4, 3), np.nan), np.full((4, 3), np.nan))
    assert len(found.readings_px) == 0


def test_without_the_sensors_forward_too_many_combinations_are_not_tried() -> None:
    def solve(readings: Array, sigma: Array) -> PointBatch:
        return reconstruct(CameraStack.of(rig(4)), readings, sigma)

    position, sigma = peaks(project(rig(4), control_points(12)))
    found = group_peaks(solve, Measurements.of(position, sigma))
    assert len(found) == 0
    assert found.cut == 12**4
    position, sigma = peaks(project(rig(4), control_points(5)))
    assert len(group_peaks(solve, Measurements.of(position, sigma))) == 5


@pytest.mark.slow
def test_twenty_markers_on_eight_sensors() -> None:
    """With 5 % of the lines missed and as many false ones."""
    cameras = CameraStack.of(rig(8))
    right = unmarked = wrong = 0
    for seed in range(2):
        scene = random_scene(cameras, 20, seed, missed=0.05, false=0.05)
        found = match_peaks(cameras, scene.position_px, scene.sigma_px)
        for owner, ambiguous in zip(scene.owners(found), found.ambiguous, strict=True):
            right += owner is not None
            unmarked += owner is not None and not ambiguous
            wrong += owner is None and not ambiguous
    assert right >= 38
    assert unmarked >= 32
    assert wrong <= 1


@pytest.mark.slow
@pytest.mark.parametrize(
    ("sensors", "markers", "missed", "false"),
    [(4, 3, 0.0, 0.0), (4, 5, 0.05, 0.05), (5, 6, 0.05, 0.05), (6, 6, 0.2, 0.2)],
)
def test_unambiguous_is_wrong_as_rarely_as_stated(
    sensors: int, markers: int, missed: float, false: float
) -> None:
    """More than three wrong ones too many come by chance once in hundreds of such tests."""
    cameras = CameraStack.of(rig(sensors))
    how = MatchSettings(detection_probability=min(1.0 - missed, 0.95), max_error_rate=0.01)
    unmarked = wrong = 0
    for seed in range(40):
        scene = random_scene(cameras, markers, seed, missed=missed, false=false)
        found = match_peaks(cameras, scene.position_px, scene.sigma_px, settings=how)
        for owner, ambiguous in zip(scene.owners(found), found.ambiguous, strict=True):
            unmarked += not ambiguous
            wrong += owner is None and not ambiguous
    assert unmarked > 50
    assert wrong <= how.max_error_rate * unmarked + 3.0 * (how.max_error_rate * unmarked) ** 0.5


@given(st.integers(0, 10_000), st.integers(4, 6), st.integers(2, 6))
@settings(max_examples=15, deadline=None)
def test_the_order_of_peaks_does_not_matter(seed: int, sensors: int, markers: int) -> None:
    cameras = CameraStack.of(rig(sensors))
    scene = random_scene(cameras, markers, seed, missed=0.1, false=0.1)
    found = match_peaks(cameras, scene.position_px, scene.sigma_px)
    order = np.argsort(np.random.default_rng(seed + 1).random(scene.position_px.shape), axis=1)
    shuffled = np.take_along_axis(scene.position_px, order, axis=1)
    again = match_peaks(cameras, shuffled, np.take_along_axis(scene.sigma_px, order, axis=1))
    np.testing.assert_array_equal(again.readings_px, found.readings_px)
    np.testing.assert_array_equal(again.ambiguous, found.ambiguous)
    for row, choice in zip(again.readings_px, again.peaks, strict=True):
        seen = choice >= 0
        np.testing.assert_array_equal(shuffled[seen.nonzero()[0], choice[seen]], row[seen])
        assert np.isnan(row[~seen]).all()


@given(st.integers(0, 10_000), st.integers(4, 6), st.integers(2, 5))
@settings(max_examples=15, deadline=None)
def test_the_order_of_sensors_does_not_matter(seed: int, sensors: int, markers: int) -> None:
    models = rig(sensors)
    scene = random_scene(CameraStack.of(models), markers, seed)
    found = match_peaks(CameraStack.of(models), scene.position_px, scene.sigma_px)
    mirrored = match_peaks(
        CameraStack.of(models[::-1]), scene.position_px[::-1], scene.sigma_px[::-1]
    )
    rows = {tuple(row) for row, a in zip(found.peaks, found.ambiguous, strict=True) if not a}
    others = {tuple(row[::-1]) for row in mirrored.peaks}
    assert rows <= others
    assert len(mirrored) == len(found)


@given(st.integers(0, 10_000), st.integers(4, 6), st.integers(2, 5), st.integers(0, 3))
@settings(max_examples=15, deadline=None)
def test_a_peak_far_away_does_not_change_the_others(
    seed: int, sensors: int, markers: int, where: int
) -> None:
    """Where no combination of the others would be seen by that sensor: at the end of its line."""
    cameras = CameraStack.of(rig(sensors))
    scene = random_scene(cameras, markers, seed)
    found = match_peaks(cameras, scene.position_px, scene.sigma_px)
    position = np.pad(scene.position_px, ((0, 0), (0, 1)), constant_values=np.nan)
    sigma = np.pad(scene.sigma_px, ((0, 0), (0, 1)), constant_values=np.nan)
    position[where, -1], sigma[where, -1] = 20_000.0, 0.02
    again = match_peaks(cameras, position, sigma)
    sure = {tuple(row) for row, a in zip(found.peaks, found.ambiguous, strict=True) if not a}
    assert sure <= {tuple(row) for row in again.peaks}


def test_a_peak_that_two_markers_share() -> None:
    """At its middle it is neither's to the noise; flagged as merged, it is both's."""
    models = rig(4)
    cameras = CameraStack.of(models)
    first = np.array([20.0, 10.0, 1500.0])
    second = first + 60.0 * models[1].rotation[1] + 1.0 * models[1].rotation[0]
    readings = project(models, np.array([first, second]))
    assert abs(readings[0, 1] - readings[1, 1]) > 1.0
    position = np.sort(readings.T, axis=1)
    merged = np.zeros(position.shape, dtype=np.bool_)
    position[1] = [position[1].mean(), np.nan]
    sigma = np.where(np.isfinite(position), 0.02, np.nan)
    assert len(match_peaks(cameras, position, sigma)) == 0
    merged[1, 0] = True
    found = match_peaks(cameras, position, sigma, merged=merged)
    assert len(found) == 2
    assert (found.peaks[:, 1] == 0).all()
    assert len({tuple(row) for row in found.peaks}) == 2
    # What it says of each is as uncertain as the settings say.
    assert (found.sigma_px[:, 1] > 1.9).all()


@pytest.mark.parametrize("sensors", [3, 4])
def test_predicted_points_tell_what_sensors_cannot(sensors: int) -> None:
    cameras = CameraStack.of(rig(sensors))
    named = wrong = 0
    for seed in range(10):
        scene = random_scene(cameras, 5, seed)
        rng = np.random.default_rng(seed)
        away = scene.places_mm + rng.normal(0.0, 2.0, scene.places_mm.shape)
        predicted = PredictedPoints(away, np.tile(4.0 * np.eye(3), (5, 1, 1)))
        found = match_peaks(cameras, scene.position_px, scene.sigma_px, predicted=predicted)
        for owner, point, doubt in zip(
            scene.owners(found), found.predicted, found.ambiguous, strict=True
        ):
            named += owner is not None and owner == point
            wrong += (owner is None or owner != point >= 0) and not doubt
    assert named >= 47
    assert wrong == 0


def test_a_prediction_that_is_not_there_takes_nothing() -> None:
    cameras = CameraStack.of(rig(3))
    scene = random_scene(cameras, 2, 5)
    beside = PredictedPoints(scene.places_mm[:1] + 60.0, np.eye(3)[None])
    assert len(match_peaks(cameras, scene.position_px, scene.sigma_px, predicted=beside)) == 0


def test_what_is_refused() -> None:
    position, sigma = peaks(project(rig(3), control_points(2)))

    def solve(readings: Array, sigma: Array) -> PointBatch:
        return reconstruct(CameraStack.of(rig(3)), readings, sigma)

    one = PredictedPoints(np.zeros((1, 3)), np.eye(3)[None])
    with pytest.raises(InvalidParameter, match="need a model"):
        group_peaks(solve, Measurements.of(position, sigma), predicted=one)
    with pytest.raises(InvalidParameter, match="finite"):
        PredictedPoints(np.full((1, 3), np.nan), np.eye(3)[None])
    with pytest.raises(InvalidParameter, match="shapes"):
        PredictedPoints(np.zeros((1, 3)), np.eye(3))
    with pytest.raises(InvalidParameter, match="max_error_rate is 0"):
        MatchSettings(max_error_rate=0.0)


@pytest.mark.parametrize(("sensors", "seen"), [(4, 4), (5, 4), (6, 4), (8, 4), (8, 6)])
def test_triples_cover_every_choice_of_sensors(sensors: int, seen: int) -> None:
    triples = covering_triples(sensors, seen)
    for choice in combinations(range(sensors), seen):
        assert any(set(triple) <= set(choice) for triple in triples)
