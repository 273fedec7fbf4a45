"""Scenes: shape of the target, length and rotation of the bar, invalid parameters."""

import csv
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.distance import pdist

from compute.errors import InvalidParameter
from hardware.simulated.scenes import (
    CalibrationTarget,
    MovingTool,
    MovingTools,
    RotatingBar,
    StillPoints,
    WavedWand,
)

SURVEY = Path(__file__).parents[3] / "validation" / "data" / "test_5_4_points.csv"

direction = st.tuples(*[st.floats(-10.0, 10.0)] * 3).filter(lambda n: np.linalg.norm(n) > 1e-3)

TETRAHEDRON = ((0.0, 0.0, 0.0), (80.0, 0.0, 0.0), (0.0, 60.0, 0.0), (10.0, 20.0, 40.0))


def test_the_frame_has_the_shape_of_test_5_4() -> None:
    with SURVEY.open() as file:
        surveyed = [[float(row[f"{axis}_mm"]) for axis in "XYZ"] for row in csv.DictReader(file)]
    points = CalibrationTarget(centre_mm=(10.0, -20.0, 1400.0), scale=0.5).points(3.0)
    assert points.shape == (19, 3)
    np.testing.assert_allclose(pdist(points), 0.5 * pdist(np.array(surveyed)), rtol=1e-12)
    np.testing.assert_allclose(points.mean(axis=0), [10.0, -20.0, 1400.0], atol=1e-9)
    # Not mirrored: the triple product of three edges keeps its sign.
    edges, original = np.diff(points, axis=0)[[0, 4, 9]], np.diff(surveyed, axis=0)[[0, 4, 9]]
    assert np.linalg.det(edges) == pytest.approx(0.125 * np.linalg.det(original))


@pytest.mark.parametrize(
    "scene",
    [
        CalibrationTarget(),
        StillPoints(((0.0, 0.0, 1500.0), (5.0, 6.0, 1400.0))),
        RotatingBar(),
        MovingTools((MovingTool(TETRAHEDRON), MovingTool(TETRAHEDRON[:3], phase=0.4))),
        WavedWand(),
    ],
)
def test_many_times_at_once_are_the_same_as_one_by_one(
    scene: CalibrationTarget | StillPoints | RotatingBar | MovingTools | WavedWand,
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


@given(
    time_s=st.floats(0.0, 1e4),
    rest=st.tuples(*[st.floats(-3.0, 3.0)] * 3),
    turn=st.tuples(*[st.floats(-3.0, 3.0)] * 3),
    held=st.tuples(*[st.floats(-200.0, 200.0)] * 3),
    phase=st.floats(0.0, 1.0),
)
def test_a_tool_stays_rigid_right_handed_and_within_its_swing(
    time_s: float,
    rest: tuple[float, float, float],
    turn: tuple[float, float, float],
    held: tuple[float, float, float],
    phase: float,
) -> None:
    tool = MovingTool(TETRAHEDRON, held_mm=held, rest_rad=rest, turn_rad=turn, phase=phase)
    scene = MovingTools((MovingTool(TETRAHEDRON[:2]), tool))
    rotation, origin = scene.pose(1, time_s)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    points = scene.points(time_s)[list(scene.numbers(1))]
    np.testing.assert_allclose(points, (rotation @ np.array(TETRAHEDRON).T).T + origin, atol=1e-9)
    away = np.abs(rotation @ held + origin - tool.centre_mm)
    assert (away <= np.array(tool.swing_mm) + 1e-9).all()


@given(time_s=st.floats(0.0, 1e5))
def test_a_wand_keeps_its_length_and_stays_in_its_volume(time_s: float) -> None:
    scene = WavedWand(
        length_mm=240.0, centre_mm=(10.0, -20.0, 1600.0), swing_mm=(200.0, 150.0, 90.0)
    )
    first, second = scene.points(time_s)
    assert np.linalg.norm(second - first) == pytest.approx(240.0, abs=1e-9)
    away = np.abs(0.5 * (first + second) - [10.0, -20.0, 1600.0])
    assert (away <= [200.0 + 1e-9, 150.0 + 1e-9, 90.0 + 1e-9]).all()


def test_a_wand_is_waved_in_all_directions_through_all_eighths_of_its_volume() -> None:
    scene = WavedWand()
    first, second = np.moveaxis(scene.points(np.linspace(0.0, scene.period_s, 2000)), 1, 0)
    along = (second - first) / scene.length_mm
    assert np.sqrt((along**2).mean(axis=0)).min() > 0.45
    above = 0.5 * (first + second) > scene.centre_mm
    counts = np.bincount(above @ np.array([4, 2, 1]), minlength=8)
    assert counts.min() > 2000 / 8 / 3
    # As fast as a hand, and smooth: positions between two exposures are nearly on a line.
    speed = np.linalg.norm(np.diff(first, axis=0), axis=1) * 2000 / scene.period_s
    assert 100.0 < speed.mean() < 800.0


def test_a_tool_turns_as_its_rotation_vector_says() -> None:
    tool = MovingTool(TETRAHEDRON, turn_rad=(0.0, 1.1, 0.0), rest_rad=(0.0, 0.0, np.pi / 2))
    rotation, _ = tool.pose(0.0)  # the swing about Y begins at its largest
    about_y = [[np.cos(1.1), 0.0, np.sin(1.1)], [0.0, 1.0, 0.0], [-np.sin(1.1), 0.0, np.cos(1.1)]]
    about_z = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    np.testing.assert_allclose(rotation, np.array(about_y) @ about_z, atol=1e-12)


def test_a_tool_moves_smoothly_and_rests_when_told() -> None:
    tools = (MovingTool(TETRAHEDRON), MovingTool(TETRAHEDRON, period_s=3.0))
    times = np.arange(0.0, 12.0, 1e-3)  # beyond the period, whose end must not show
    points = MovingTools(tools).points(times)
    speed = np.linalg.norm(np.diff(points, axis=0), axis=-1) / 1e-3
    assert speed.max() < 2000.0
    assert np.abs(np.diff(speed, axis=0)).max() < 0.01 * speed.max()
    assert np.ptp(points, axis=0).min() > 30.0  # all axes take part
    still = MovingTools(tools, moving=False).points(times)
    np.testing.assert_array_equal(still, np.broadcast_to(points[0], still.shape))


def test_a_pivoted_tool_keeps_its_tip() -> None:
    tip = (0.0, 0.0, -150.0)
    tool = MovingTool(TETRAHEDRON, swing_mm=(0.0, 0.0, 0.0), held_mm=tip)
    rotation, origin = tool.pose(np.linspace(0.0, 6.0, 50))
    np.testing.assert_allclose(
        rotation @ tip + origin, np.broadcast_to(tool.centre_mm, (50, 3)), atol=1e-9
    )
    assert np.ptp(origin, axis=0).min() > 10.0


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: StillPoints(()), "points_mm is .*; it must be of length at least 1"),
        (lambda: StillPoints(((0.0, 0.0, np.nan),)), "points_mm is nan; it must be at least"),
        (lambda: StillPoints(((0.0, 0.0),)), "points_mm is .*; it must be of length 3"),  # type: ignore[arg-type]
        (lambda: CalibrationTarget(scale=0.0), "scale is 0.0; it must be more than 0"),
        (lambda: CalibrationTarget(centre_mm=(0.0, 0.0, np.inf)), "centre_mm is inf; it must be"),
        (lambda: RotatingBar(length_mm=-292.0), "length_mm is -292.0; it must be more than 0"),
        (lambda: RotatingBar(period_s=0.0), "period_s is 0.0; it must be at least 0.001"),
        (lambda: RotatingBar(plane_normal=(0.0, 0.0, 0.0)), "plane_normal is .*; its length must"),
        (lambda: MovingTools(()), "tools is .*; it must be of length at least 1"),
        (lambda: MovingTool(()), "markers_mm is .*; it must be of length at least 1"),
        (lambda: MovingTool(TETRAHEDRON, turn_rad=(0.0, 11.0, 0.0)), "turn_rad is 11.0; it must"),
        (lambda: MovingTool(TETRAHEDRON, period_s=0.0), "period_s is 0.0; it must be at least"),
    ],
)
def test_scenes_without_meaning_are_refused(make: object, message: str) -> None:
    assert callable(make)
    with pytest.raises(InvalidParameter, match=message):
        make()
