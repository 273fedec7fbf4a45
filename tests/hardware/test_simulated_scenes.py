"""Scenes: the frame's shape, the bar's length and turn, what is refused."""

import csv
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.distance import pdist

from compute.errors import InvalidParameter
from hardware.simulated.scenes import CalibrationFrame, RotatingBar, StillPoints

SURVEY = Path(__file__).parents[2] / "validation" / "data" / "test_5_4_points.csv"

direction = st.tuples(*[st.floats(-10.0, 10.0)] * 3).filter(lambda n: np.linalg.norm(n) > 1e-3)


def test_the_frame_has_the_shape_of_test_5_4() -> None:
    with SURVEY.open() as file:
        surveyed = [[float(row[f"{axis}_mm"]) for axis in "XYZ"] for row in csv.DictReader(file)]
    points = CalibrationFrame(centre_mm=(10.0, -20.0, 1400.0), scale=0.5).points(3.0)
    assert points.shape == (19, 3)
    np.testing.assert_allclose(pdist(points), 0.5 * pdist(np.array(surveyed)), rtol=1e-12)
    np.testing.assert_allclose(points.mean(axis=0), [10.0, -20.0, 1400.0], atol=1e-9)
    # Not mirrored: the triple product of three edges keeps its sign.
    edges, original = np.diff(points, axis=0)[[0, 4, 9]], np.diff(surveyed, axis=0)[[0, 4, 9]]
    assert np.linalg.det(edges) == pytest.approx(0.125 * np.linalg.det(original))


@pytest.mark.parametrize(
    "scene",
    [CalibrationFrame(), StillPoints(((0.0, 0.0, 1500.0), (5.0, 6.0, 1400.0))), RotatingBar()],
)
def test_many_times_at_once_are_the_same_as_one_by_one(
    scene: CalibrationFrame | StillPoints | RotatingBar,
) -> None:
    times = np.array([0.0, 0.3, 17.25])
    together = scene.points(times)
    assert together.shape == (3, scene.markers, 3)
    for time_s, points in zip(times, together, strict=True):
        np.testing.assert_array_equal(scene.points(float(time_s)), points)


@given(time_s=st.floats(0.0, 1e5), normal=direction)
def test_the_bar_keeps_its_length_its_middle_and_its_plane(
    time_s: float, normal: tuple[float, float, float]
) -> None:
    bar = RotatingBar(plane_normal=normal, centre_mm=(3.0, -40.0, 1450.0))
    first, second = bar.points(time_s)
    assert np.linalg.norm(first - second) == pytest.approx(292.0, abs=1e-9)
    np.testing.assert_allclose((first + second) / 2, [3.0, -40.0, 1450.0], atol=1e-9)
    assert (first - second) @ normal / np.linalg.norm(normal) == pytest.approx(0.0, abs=1e-9)


@given(time_s=st.floats(0.0, 1e4), normal=direction)
def test_the_bar_turns_right_handed_once_in_two_seconds(
    time_s: float, normal: tuple[float, float, float]
) -> None:
    bar = RotatingBar(plane_normal=normal)
    now, quarter, half, whole = bar.points(np.array([time_s, time_s + 0.5, time_s + 1, time_s + 2]))
    np.testing.assert_allclose(whole, now, atol=1e-6)
    np.testing.assert_allclose(half, now[::-1], atol=1e-6)
    turned = np.cross(now[0] - now[1], quarter[0] - quarter[1])
    np.testing.assert_allclose(
        turned, 292.0**2 * np.asarray(normal) / np.linalg.norm(normal), atol=1e-3
    )


def test_the_horizontal_bar_starts_along_x() -> None:
    np.testing.assert_allclose(
        RotatingBar().points(0.0), [[146.0, 0.0, 1500.0], [-146.0, 0.0, 1500.0]], atol=1e-12
    )


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: StillPoints(()), "points_mm is .*; it must be of length at least 1"),
        (lambda: StillPoints(((0.0, 0.0, np.nan),)), "points_mm is nan; it must be at least"),
        (lambda: StillPoints(((0.0, 0.0),)), "points_mm is .*; it must be of length 3"),  # type: ignore[arg-type]
        (lambda: CalibrationFrame(scale=0.0), "scale is 0.0; it must be more than 0"),
        (lambda: CalibrationFrame(centre_mm=(0.0, 0.0, np.inf)), "centre_mm is inf; it must be"),
        (lambda: RotatingBar(length_mm=-292.0), "length_mm is -292.0; it must be more than 0"),
        (lambda: RotatingBar(period_s=0.0), "period_s is 0.0; it must be at least 0.001"),
        (lambda: RotatingBar(plane_normal=(0.0, 0.0, 0.0)), "plane_normal is .*; its length must"),
    ],
)
def test_scenes_without_meaning_are_refused(make: object, message: str) -> None:
    assert callable(make)
    with pytest.raises(InvalidParameter, match=message):
        make()
