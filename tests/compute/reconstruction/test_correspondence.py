"""Peaks of several markers at once: grouped rightly, or not at all."""

import numpy as np
import pytest
from numpy.typing import NDArray

from compute.camera.stack import CameraStack
from compute.reconstruction.correspondence import Correspondence, match_peaks
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


def test_doubt_grows_with_what_is_missing() -> None:
    """Five markers; when a fifth of their lines is missed, wrong combinations fit now and then."""
    rng = np.random.default_rng(4)
    marked = {}
    wrong_unmarked = unmarked = 0
    for missing in (0.0, 0.2):
        flags: list[bool] = []
        for seed in range(100):
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


def test_too_many_combinations_are_not_tried() -> None:
    assert len(match(4, project(rig(4), control_points(7))).readings_px) > 0
    assert len(match(4, project(rig(4), control_points(8))).readings_px) == 0
