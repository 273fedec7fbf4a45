import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from compute.camera.model import SensorGeometry
from compute.camera.observation_checks import MIN_POINT_DISTANCE_MM, check_observations
from compute.errors import (
    DuplicatePoint,
    InvalidParameter,
    LumilineError,
    NonFiniteValue,
    ReadingOutsideSensor,
)

SENSORS = [SensorGeometry("left", 100), SensorGeometry("right", 200)]


def arrays(count=6):
    rng = np.random.default_rng(2)
    points, readings = rng.uniform(-9.0, 9.0, (count, 3)), rng.uniform(0.0, 99.0, (count, 2))
    readings[1, 0] = np.nan
    return points, readings, np.full((count, 2), 0.1)


def refused(error: type[LumilineError], words: str, points, readings, sigma=None) -> None:
    with pytest.raises(error, match=words):
        check_observations(points, readings, SENSORS, sigma)


def test_what_is_right_passes() -> None:
    points, readings, sigma = arrays()
    check_observations(points, readings, SENSORS, None)
    check_observations(points, readings, SENSORS, sigma)
    sigma[1, 0] = np.nan  # of a reading that is not there
    readings[0], readings[2] = (-0.5, -0.5), (99.5, 199.5)
    check_observations(points, readings, SENSORS, sigma)
    for count in (0, 1):
        check_observations(points[:count], readings[:count], SENSORS, sigma[:count])


def test_shapes() -> None:
    points, readings, sigma = arrays()
    refused(InvalidParameter, r"points_mm .*\(6, 2\); it must be \(N, 3\)", points[:, :2], readings)
    words = r"readings_px .*\(6, 1\); 6 points and 2 sensors make \(6, 2\)"
    refused(InvalidParameter, words, points, readings[:, :1])
    words = r"sigma_px .*\(5, 2\); the readings have \(6, 2\)"
    refused(InvalidParameter, words, points, readings, sigma[:5])


@given(st.integers(0, 5), st.integers(0, 1), st.sampled_from([np.inf, -np.inf]))
@settings(deadline=None, max_examples=10)
def test_values_name_their_point_and_sensor(row, column, value) -> None:
    points, readings, sigma = arrays()
    reading = rf"point {row + 1} by sensor {SENSORS[column].name}"
    changed = readings.copy()
    changed[row, column] = value
    refused(NonFiniteValue, rf"{reading} is {value}; it must be finite", points, changed)
    changed[row, column] = SENSORS[column].pixels - 0.4
    words = rf"point {row + 1} lies outside sensor {SENSORS[column].name}, whose"
    refused(ReadingOutsideSensor, words, points, changed)
    changed[row, column] = 3.0
    for wrong in (0.0, np.nan, value, 2e4):
        sigma[row, column] = wrong
        refused(InvalidParameter, rf"{reading} is {wrong} px; it must", points, changed, sigma)
    points[row, column] = value
    refused(NonFiniteValue, f"point {row + 1} has {'XY'[column]} = {value}", points, readings)


@given(
    st.lists(st.integers(0, 19), min_size=2, max_size=2, unique=True),
    st.tuples(*(st.sampled_from([-0.9, 0.0, 0.9]),) * 3),
)
@settings(deadline=None, max_examples=30)
def test_two_points_at_one_place(pair, shift) -> None:
    """Wherever they stand in the list, and though others lie between them along every axis."""
    rng = np.random.default_rng(3)
    points = np.zeros((20, 3))
    points[:] = np.arange(20)[:, None] * [1.0, 0.0, 0.3 * MIN_POINT_DISTANCE_MM]
    points = points[rng.permutation(20)]
    first, second = sorted(pair)
    readings = np.zeros((20, 2))
    check_observations(points, readings, SENSORS, None)
    points[second] = points[first] + MIN_POINT_DISTANCE_MM * np.array(shift)
    words = f"points {first + 1} and {second + 1} have the same position"
    refused(DuplicatePoint, words, points, readings)


@pytest.mark.slow
def test_very_many_points_at_one_place() -> None:
    words = "points 1 and 2 have"
    refused(DuplicatePoint, words, np.zeros((100_000, 3)), np.zeros((100_000, 2)))
