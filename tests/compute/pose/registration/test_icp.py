"""Registration by a surface: the truth where the surface holds it, and a reason where not."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from compute.errors import (
    HighError,
    InvalidParameter,
    NonFiniteValue,
    TooFewPoints,
    UndeterminedParameters,
)
from compute.pose.registration.icp import IcpSettings, register_surface
from compute.pose.registration.surface import PointCloud, TriangleMesh
from compute.transform import Transform, rotation_matrix
from tests.compute.pose.motions import Array

ALONE = IcpSettings(trim=0.0, start_turn_rad=0.0, start_shift_mm=0.0)
CUBE = ConvexHull(np.array(np.meshgrid([0.0, 60.0], [0.0, 80.0], [0.0, 110.0])).reshape(3, -1).T)


def body(chance: np.random.Generator, count: int, axes: tuple[float, ...] = (60.0, 80.0, 110.0),
         bumps: float = 1.0) -> tuple[Array, Array]:  # fmt: skip
    """Return points of a head-like body, and their directions from its middle."""
    way = chance.normal(size=(count, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    x, y, z = way.T
    size = 1.0 + bumps * (0.15 * x**3 + 0.2 * y * z + 0.1 * x * y)
    return way * axes * size[:, None], way


def mesh(
    count: int = 1500, axes: tuple[float, ...] = (60.0, 80.0, 110.0), bumps: float = 1.0
) -> TriangleMesh:
    vertices, ways = body(np.random.default_rng(0), count, axes, bumps)
    return TriangleMesh(vertices, ConvexHull(ways).simplices)


def on(surface: TriangleMesh, chance: np.random.Generator, count: int) -> Array:
    """Return points of a mesh, evenly over its triangles."""
    chosen = chance.integers(len(surface.faces), size=count)
    corners = surface.vertices_mm[surface.faces[chosen]]
    return np.einsum("ni,nij->nj", chance.dirichlet([1.0, 1.0, 1.0], count), corners)


def start_near(truth: Transform, points: Array, chance: np.random.Generator) -> Transform:
    """Return a start some 2 degrees and 3 mm off."""
    turn = rotation_matrix(0.02 * chance.normal(size=3)) @ truth.rotation
    middle = points.mean(axis=0)
    shift = truth.apply(middle) - turn @ middle + 2.0 * chance.normal(size=3)
    return Transform(turn, shift)


def squared_distance(point: Array, corners: Array) -> float:
    """Squared distance of a point to a triangle: the least over its face, edges and corners."""
    found = [((point - corner) ** 2).sum() for corner in corners]
    for sides in ([0, 1], [1, 2], [2, 0], [0, 1, 2]):
        # The foot on the line or plane through these corners, if it is between them.
        start, spans = corners[sides[0]], (corners[sides[1:]] - corners[sides[0]]).T
        shares = np.linalg.lstsq(spans, point - start)[0]
        if shares.min() >= 0.0 and shares.sum() <= 1.0:
            found.append(((start + spans @ shares - point) ** 2).sum())
    return min(found)


@pytest.mark.slow
@settings(max_examples=30)
@given(st.integers(0, 10_000), st.integers(1, 60))
def test_the_nearest_place_is_the_nearest_of_all_triangles(seed: int, scale: int) -> None:
    chance = np.random.default_rng(seed)
    # Triangles of very different sizes: the middle of the nearest may be far.
    vertices = chance.normal(size=(40, 3)) * chance.uniform(0.1, 10.0, (40, 1))
    surface = TriangleMesh(vertices, chance.permuted(np.arange(40).repeat(3)).reshape(40, 3))
    points = scale * 0.2 * chance.normal(size=(20, 3))
    places, ways = surface.nearest(points)
    corners = surface.vertices_mm[surface.faces]
    sides = corners[:, 1:] - corners[:, :1]
    size = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    wanted = np.sqrt(
        [min(squared_distance(one, each) for each in corners[size > 1e-9]) for one in points]
    )
    found = np.linalg.norm(places - points, axis=1)
    assert np.allclose(found, wanted, atol=1e-9)
    assert np.allclose(np.einsum("ni,ni->n", points - places, ways), found, atol=1e-9)


def test_a_large_triangle_is_near_also_where_its_middle_is_far() -> None:
    large = np.array([[0.0, 0.0, 0.0], [900.0, 0.0, 0.0], [0.0, 900.0, 0.0]])
    small = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    # Thirty small ones above a corner of the large one, which is nearer to the point.
    every = [large, *(small + np.array([0.0, 0.0, 20.0 + one]) for one in range(30))]
    surface = TriangleMesh(np.concatenate(every), np.arange(93).reshape(31, 3))
    places, ways = surface.nearest(np.array([[2.0, 2.0, 3.0], [2.0, 2.0, 60.0]]))
    assert np.allclose(places[0], [2.0, 2.0, 0.0])
    assert np.allclose(ways[0], [0.0, 0.0, 1.0])
    assert np.allclose(places[1], [0.5, 0.5, 49.0])


def test_places_on_a_triangle() -> None:
    corners = np.array([[0.0, 0.0, 0.0], [4.0, 0.0, 0.0], [0.0, 4.0, 0.0]])
    for point, wanted in (
        ([1.0, 1.0, 5.0], [1.0, 1.0, 0.0]),  # above it
        ([2.0, -3.0, 1.0], [2.0, 0.0, 0.0]),  # beside an edge
        ([3.0, 3.0, 0.0], [2.0, 2.0, 0.0]),  # beside the long one
        ([9.0, -1.0, 2.0], [4.0, 0.0, 0.0]),  # beyond a corner
    ):
        places, _ = TriangleMesh(corners, np.arange(3)[None]).nearest(np.array([point]))
        assert np.allclose(places, [wanted])


def test_exact_points_of_a_mesh_come_to_lie_where_they_were() -> None:
    surface = mesh()
    for seed in range(3):
        chance = np.random.default_rng(seed)
        truth = Transform(rotation_matrix(chance.normal(size=3)), 100.0 * chance.normal(size=3))
        points = truth.inverse().apply(on(surface, chance, 60))
        found = register_surface(points, surface, start_near(truth, points, chance), ALONE)
        assert found.rms_mm < 0.01
        assert np.abs(found.transform.apply(points) - truth.apply(points)).max() < 0.1
        assert found.stiffness_ratio > 0.005


def test_the_covariance_is_about_what_the_transform_errs_by() -> None:
    surface = mesh()
    squares = []
    for seed in range(15):
        chance = np.random.default_rng(seed)
        truth = Transform(rotation_matrix(chance.normal(size=3)), 100.0 * chance.normal(size=3))
        seen = on(surface, chance, 80) + 0.3 * chance.normal(size=(80, 3))
        points = truth.inverse().apply(seen)
        found = register_surface(points, surface, start_near(truth, points, chance), ALONE)
        error = found.transform.difference(truth)
        assert found.transform.covariance is not None
        squares.append(error @ np.linalg.solve(found.transform.covariance, error))
    # The deviation is estimated from a median, and a mesh has edges: a third is little here.
    assert 6.0 * 0.67 < np.mean(squares) < 6.0 * 1.5


def test_points_that_are_not_of_the_surface_are_trimmed() -> None:
    surface, chance = mesh(), np.random.default_rng(1)
    seen = on(surface, chance, 80) + 0.1 * chance.normal(size=(80, 3))
    truth = Transform.identity()
    seen[:6] *= 1.2
    start = start_near(truth, seen, chance)
    settings = IcpSettings(trim=0.1, start_turn_rad=0.0, start_shift_mm=0.0)
    trimmed = register_surface(seen, surface, start, settings)
    whole = register_surface(seen, surface, start, ALONE)
    assert not trimmed.kept[:6].any()
    assert trimmed.kept.sum() == 72
    errors = [np.abs(one.transform.apply(seen) - seen).max() for one in (trimmed, whole)]
    assert errors[0] < 0.3
    assert errors[0] < 0.3 * errors[1]


@pytest.mark.parametrize("normals", [True, False])
def test_a_cloud_with_and_without_normals(normals: bool) -> None:
    points = body(np.random.default_rng(0), 6000)[0]
    given_normals = None
    if normals:
        corners = mesh(6000)
        given_normals = corners.nearest(points * 1.001)[1]
    cloud = PointCloud(points, given_normals)
    assert cloud.exact_normals is normals
    chance = np.random.default_rng(5)
    probe = body(chance, 150)[0]
    found = register_surface(probe, cloud, start_near(Transform.identity(), probe, chance), ALONE)
    # The cloud's points are some 3 mm apart.
    assert np.abs(found.transform.apply(probe) - probe).max() < (0.6 if normals else 2.0)


@pytest.mark.parametrize(
    ("axes", "motion"),
    [((80.0, 80.0, 80.0), "a rotation about"), ((60.0, 60.0, 110.0), "a rotation about")],
)
def test_a_surface_that_lets_the_points_slide_is_refused(
    axes: tuple[float, ...], motion: str
) -> None:
    surface = mesh(4000, axes, 0.0)
    points = on(surface, np.random.default_rng(0), 100)
    start = Transform.from_rotation_vector(np.array([0.0, 0.0, 0.02]), np.array([1.0, 0.0, 0.0]))
    with pytest.raises(UndeterminedParameters, match=motion) as caught:
        register_surface(points, surface, start, ALONE)
    assert caught.value.context["stiffness_ratio"] < 1e-3  # type: ignore[operator]
    if axes[2] > axes[0]:
        # It is the rotation about the long axis.
        assert "1.00) near" in str(caught.value.context["motion"])


def test_a_plane_lets_points_shift() -> None:
    chance = np.random.default_rng(0)
    flat = np.concatenate([chance.uniform(-100.0, 100.0, (3000, 2)), np.zeros((3000, 1))], axis=1)
    points = 0.5 * flat[:50]
    cloud = PointCloud(flat, np.broadcast_to([0.0, 0.0, 2.0], flat.shape))
    with pytest.raises(UndeterminedParameters):
        register_surface(points, cloud, Transform.identity(), ALONE)


@pytest.mark.parametrize("count", [150, 450])
def test_another_answer_is_told(count: int) -> None:
    """A prism of twelve sides is nearly the same turned by a side; some points of many find it."""
    angles = np.linspace(0.0, 2.0 * np.pi, 13)[:-1]
    ring = np.stack([50.0 * np.cos(angles), 50.0 * np.sin(angles)], axis=1)
    prism = np.concatenate([np.c_[ring, np.zeros(12)], np.c_[ring, np.full(12, 70.0)]])
    surface = TriangleMesh(prism, ConvexHull(prism).simplices)
    points = on(surface, np.random.default_rng(0), count)
    settings = IcpSettings(trim=0.0, start_turn_rad=np.radians(29.0), start_shift_mm=0.0)
    found = register_surface(points, surface, Transform.identity(), settings)
    assert np.abs(found.transform.apply(points) - points).max() < 0.05
    assert found.rms_mm < 0.01
    # Exact here and a side on: the same surface, and other points on it.
    assert found.other is not None
    turned = found.other.difference(Transform.identity())[:3]
    assert np.linalg.norm(turned) == pytest.approx(np.radians(30.0), abs=0.01)
    settings = IcpSettings(trim=0.0, start_turn_rad=0.03, start_shift_mm=1.0)
    assert register_surface(points, surface, Transform.identity(), settings).other is None


def test_requests_that_cannot_be_served_are_told_why() -> None:
    surface = TriangleMesh(CUBE.points, CUBE.simplices)
    points = on(surface, np.random.default_rng(0), 40)
    with pytest.raises(TooFewPoints, match=r"11 points .* 12 are needed"):
        register_surface(points[:11], surface, Transform.identity())
    with pytest.raises(HighError, match="must be within 5 mm"):
        register_surface(2.0 * points, surface, Transform.identity(), ALONE)
    with pytest.raises(NonFiniteValue):
        register_surface(points * np.nan, surface, Transform.identity())
    with pytest.raises(InvalidParameter, match=r"\(40, 2\)"):
        register_surface(points[:, :2], surface, Transform.identity())
    with pytest.raises(InvalidParameter, match=r"trim is 0\.5"):
        IcpSettings(trim=0.5)
    with pytest.raises(InvalidParameter, match="vertices 1 to 8; there are 8"):
        TriangleMesh(CUBE.points, CUBE.simplices + 1)
    with pytest.raises(InvalidParameter, match="whole numbers"):
        TriangleMesh(CUBE.points, CUBE.simplices * 1.0)
    with pytest.raises(TooFewPoints, match="none of 2 triangles"):
        TriangleMesh(CUBE.points, np.array([[0, 0, 1], [2, 2, 2]]))
    with pytest.raises(TooFewPoints, match="cloud of 5 points"):
        PointCloud(points[:5])
    with pytest.raises(InvalidParameter, match="normals"):
        PointCloud(points, np.zeros_like(points))


def test_in_parts_the_nearest_are_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    """In the middle of a body many triangles may be the nearest, and are looked at in parts."""
    surface = mesh(300, (80.0, 80.0, 80.0), bumps=0.01)
    points = np.random.default_rng(0).normal(size=(40, 3))
    at_once = surface.nearest(points)
    monkeypatch.setattr("compute.pose.registration.surface._BATCH_POINTS", 7)
    in_parts = surface.nearest(points)
    for one, other in zip(at_once, in_parts, strict=True):
        assert np.array_equal(one, other)


def test_it_is_ended_by_who_is_told() -> None:
    surface, chance = mesh(200), np.random.default_rng(0)
    points, start = on(surface, chance, 40), Transform.identity()
    looks: list[None] = []
    register_surface(points, surface, start, ALONE, lambda: looks.append(None))
    assert len(looks) > 1

    def enough() -> None:
        if len(looks) == 3:
            raise TimeoutError("enough")
        looks.append(None)

    looks.clear()
    with pytest.raises(TimeoutError):
        register_surface(points, surface, start, tell=enough)
    assert len(looks) == 3
