"""Tools are told by their geometry, not guessed; unfit geometries are refused with the values."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from compute.errors import DegenerateTool, IndistinguishableTools, InvalidParameter, NonFiniteValue
from compute.pose.acquisition.marker_labelling import identify_tools
from compute.pose.acquisition.tool_geometry import (
    check_distinguishable,
    check_tool,
    exchangeable_markers,
)
from compute.pose.rigid_body import RigidBody
from compute.pose.settings import LabellingSettings
from tests.compute.pose.scene import (
    MARKERS_MM,
    Array,
    body,
    other,
    pointer,
    random_rotation,
)

POINT_SIGMA_MM = 0.05
EXACT = LabellingSettings(marker_sigma_mm=0.01)


def covariances(count: int) -> Array:
    return np.broadcast_to(POINT_SIGMA_MM**2 * np.eye(3), (count, 3, 3))


def seen(bodies: list, rng: np.random.Generator, stray: int = 0) -> tuple[Array, Array]:
    """Their markers and stray points, shuffled, and where each of them went."""
    places = [one.markers_mm for one in bodies]
    strays = rng.uniform(-300.0, 300.0, (stray, 3)) + np.array([0.0, 0.0, 1500.0])
    points = np.concatenate([*places, strays])
    order = rng.permutation(len(points))
    noisy = points[order] + POINT_SIGMA_MM * rng.standard_normal(points.shape)
    return noisy, np.argsort(order)


@given(st.integers(0, 2**32 - 1), st.integers(0, 12))
@settings(max_examples=30, deadline=None)
def test_two_tools_are_found_among_strays(seed: int, stray: int) -> None:
    rng = np.random.default_rng(seed)
    bodies = [body(pointer(), seed), body(other(), seed + 1, np.array([150.0, 20.0, 1450.0]))]
    points, place = seen(bodies, rng, stray)
    found = identify_tools([one.tool for one in bodies], points, covariances(len(points)))
    by_tool = {one.tool: one for one in found}
    for index in range(2):
        one = by_tool[index]
        assert one.labelling.points.tolist() == place[4 * index : 4 * index + 4].tolist()
        assert one.ambiguity is None
        assert one.labelling.rotation == pytest.approx(bodies[index].rotation, abs=0.05)


def test_the_covariance_of_a_found_pose_is_right() -> None:
    rng = np.random.default_rng(0)
    squares = []
    for seed in range(150):
        true = body(pointer(), seed)
        points, _ = seen([true], rng)
        (found,) = identify_tools([true.tool], points, covariances(4), EXACT)
        from compute.transform import rotation_vector

        off = np.concatenate(
            [
                rotation_vector(true.rotation @ found.labelling.rotation.T),
                true.centroid_mm - found.labelling.centroid_mm,
            ]
        )
        squares.append(off @ np.linalg.solve(found.labelling.covariance, off))
    assert np.mean(squares) == pytest.approx(6.0, abs=1.2)


def test_a_missing_marker_is_left_out() -> None:
    rng = np.random.default_rng(1)
    points, place = seen([body(pointer(), 3)], rng, 3)
    points[place[1]] = np.nan
    (found,) = identify_tools([pointer()], points, covariances(len(points)))
    assert found.labelling.points[1] == -1
    assert found.labelling.points[[0, 2, 3]].tolist() == place[[0, 2, 3]].tolist()


def test_two_markers_are_not_enough() -> None:
    rng = np.random.default_rng(2)
    points, place = seen([body(pointer(), 3)], rng)
    points[place[:2]] = np.nan
    assert identify_tools([pointer()], points, covariances(4)) == []
    with pytest.raises(InvalidParameter, match="min_markers is 2"):
        LabellingSettings(min_markers=2)


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=20, deadline=None)
def test_a_mirrored_tool_is_not_the_tool(seed: int) -> None:
    rng = np.random.default_rng(seed)
    mirrored = RigidBody("mirrored", MARKERS_MM * [1.0, 1.0, -1.0])
    true = body(mirrored, seed)
    points, _ = seen([true], rng)
    # Any three of its markers are in a plane, and look the same from behind: so four.
    found = identify_tools([pointer()], points, covariances(4), replace(EXACT, min_markers=4))
    assert found == []
    (own,) = identify_tools([mirrored], points, covariances(4), EXACT)
    assert own.ambiguity is None


def test_two_tools_of_one_geometry_are_in_doubt() -> None:
    rng = np.random.default_rng(3)
    twin = replace(pointer(), name="twin")
    points, _ = seen([body(pointer(), 1)], rng)
    (found,) = identify_tools([pointer(), twin], points, covariances(4))
    assert found.ambiguity is not None
    assert 'tool "pointer" and tool "twin"' in found.ambiguity


def test_a_symmetric_view_is_in_doubt() -> None:
    # All four differ; of three of them two sides are equal.
    tool = RigidBody("kite", np.array([[0.0, 0, 0], [60, 0, 0], [30, 70, 0], [10, 20, 30]]))
    check_tool(tool)
    rng = np.random.default_rng(4)
    points, place = seen([body(tool, 2)], rng)
    (whole,) = identify_tools([tool], points, covariances(4))
    assert whole.ambiguity is None
    points[place[3]] = np.nan
    (part,) = identify_tools([tool], points, covariances(4))
    assert part.ambiguity is not None
    assert "more than one way" in part.ambiguity


def test_a_point_is_used_once() -> None:
    rng = np.random.default_rng(5)
    points, _ = seen([body(pointer(), 1), body(other(), 2)], rng)
    found = identify_tools([pointer(), other()], points, covariances(8))
    used = np.concatenate([one.labelling.points for one in found])
    assert len(used) == len(set(used.tolist())) == 8


def test_a_search_without_end_gives_up() -> None:
    grid = np.stack(np.meshgrid(*[np.arange(4.0) * 30.0] * 2), axis=-1).reshape(-1, 2)
    points = np.column_stack([grid, np.zeros(16)])
    tool = RigidBody("grid", points.copy())
    few = LabellingSettings(max_search_steps=50)
    assert identify_tools([tool], points, covariances(16), few) == []


def test_good_tools_pass() -> None:
    check_tool(pointer())
    check_tool(other())
    check_tool(pointer(strobed=True))
    check_distinguishable([pointer(), other(), replace(pointer(strobed=True), name="lit")])


@pytest.mark.parametrize(
    ("markers", "words"),
    [
        ([[0.0, 0, 0], [50, 0, 0]], "has 2 markers"),
        ([[0.0, 0, 0], [50, 0, 0], [90, 1, 0]], "lie on a line, to 0.261 mm"),
        ([[0.0, 0, 0], [50, 0, 0], [20, 40, 0], [22, 42, 1]], "are 3 mm apart"),
        ([[0.0, 0, 0], [60, 0, 0], [30, 40, 0]], "1 as 2, 2 as 1"),
        ([[0.0, 0, 0], [60, 0, 0], [60, 60, 0], [0, 60, 0]], "markers exchanged"),
    ],
)
def test_degenerate_tools_are_refused_with_values(markers: list, words: str) -> None:
    with pytest.raises(DegenerateTool, match=words) as caught:
        check_tool(RigidBody("bad", np.array(markers)))
    assert '"bad"' in caught.value.detail


def test_strobed_markers_may_be_symmetric_but_not_on_a_line() -> None:
    square = np.array([[0.0, 0, 0], [60, 0, 0], [60, 60, 0], [0, 60, 0]])
    check_tool(RigidBody("square", square, (3, 4, 5, 6)))
    with pytest.raises(DegenerateTool, match="must all be different"):
        check_tool(RigidBody("square", square, (3, 4, 4, 6)))
    with pytest.raises(DegenerateTool, match="on a line"):
        check_tool(RigidBody("line", square[:2].repeat(2, axis=0), (1, 2, 3, 4)))


def test_a_mirrored_order_is_no_exchange() -> None:
    # A tetrahedron with a mirror plane: its distances agree with two markers exchanged, itself not.
    chiral = np.array([[0.0, 30, 0], [0, -30, 0], [50, 0, 10], [-20, 0, 45]])
    assert exchangeable_markers(RigidBody("chiral", chiral)) == []
    check_tool(RigidBody("chiral", chiral))


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=20, deadline=None)
def test_a_shape_is_alike_wherever_it_lies(seed: int) -> None:
    rng = np.random.default_rng(seed)
    order = rng.permutation(4)
    copy = (MARKERS_MM @ random_rotation(rng).T + rng.uniform(-50.0, 50.0, 3))[order]
    with pytest.raises(IndistinguishableTools) as caught:
        check_distinguishable([pointer(), RigidBody("copy", copy)])
    first, second = caught.value.context["tools"]  # type: ignore[misc]
    assert (first, second) == ("pointer", "copy")
    distance = np.linalg.norm(MARKERS_MM[0] - MARKERS_MM[1])
    assert f"markers 1 and 2 of the first are {distance:.2f} mm apart" in caught.value.detail


def test_three_alike_markers_are_too_many() -> None:
    like = MARKERS_MM.copy()
    like[3] = [10.0, -60.0, 40.0]
    with pytest.raises(IndistinguishableTools, match=r"look alike within 0\.25 mm") as caught:
        check_distinguishable([pointer(), RigidBody("like", like)])
    assert len(caught.value.context["pairs"]) == 3  # type: ignore[arg-type]


def test_strobe_slots_are_not_shared() -> None:
    first = pointer(strobed=True)
    second = RigidBody("second", MARKERS_MM, (3, 4, 5, 6))
    with pytest.raises(IndistinguishableTools, match=r"share the strobe slots \[3\]"):
        check_distinguishable([first, second])
    check_distinguishable([first, replace(second, strobe_markers=(4, 5, 6, 7))])


def test_places_must_be_finite() -> None:
    bad = MARKERS_MM.copy()
    bad[2, 1] = np.nan
    with pytest.raises(NonFiniteValue, match="marker 3"):
        check_tool(RigidBody("bad", bad))
