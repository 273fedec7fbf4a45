"""The NumPy tracer against what is known of single surfaces, and against definitions."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq

from compute.errors import InvalidParameter
from compute.optics.coded_aperture.window_refraction import transmittances
from compute.optics.tracing.intersection import intersect, normal
from compute.optics.tracing.reference_tracer import CHUNK_RAYS, RayStatus, trace_rays
from compute.optics.tracing.surface_records import pack
from compute.optics.tracing.surfaces import (
    Aperture,
    Conic,
    Cylinder,
    Plane,
    Surface,
    SurfaceStack,
    Toroid,
    sag,
)
from tests.compute.optics.tracing.ray_systems import (
    assert_consistent,
    assert_same_rays,
    random_rays,
    random_shape,
    random_stack,
)

SEEDS = st.integers(0, 2**32 - 1)
AHEAD = np.array([[0.0, 0.0, 1.0]])


def image_at(z):
    return Surface(Plane(), (0.0, 0.0, z))


def columns(rows):
    return tuple(column.copy() for column in rows.T)


def meet(shape, origins, directions):
    """Distances along rays to a shape in its own frame, and the normals there."""
    record = pack(SurfaceStack((Surface(shape),), image_at(1e3)))[0]
    with np.errstate(all="ignore"):
        distance, place = intersect(record, columns(origins), columns(directions))
        n = None if isinstance(shape, Plane) else np.column_stack(normal(record, place))
    return distance, np.column_stack(place), n


def height(shape, origin, direction, t):
    x, y, z = (origin + np.multiply.outer(t, direction)).T
    return z - sag(shape, x, y)


@settings(max_examples=60, deadline=None)
@given(SEEDS)
def test_the_first_crossing_with_the_sheet_of_the_vertex(seed):
    """Against the shape's own sag, sampled along the ray: on it, and none before."""
    rng = np.random.default_rng(seed)
    shape = random_shape(rng)
    origins, directions = rng.normal(0.0, 20.0, (20, 3)), rng.normal(size=(20, 3))
    origins[:10, 2] -= 60.0
    directions[:10] = rng.normal(0.0, 10.0, (10, 3)) - origins[:10]
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    samples = np.linspace(0.0, 200.0, 4001)
    distance, place, n = meet(shape, origins, directions)
    met = np.isfinite(distance)
    assert (distance[met] >= -1e-9).all()
    x, y, z = place[met].T
    # Across the surface: at its rim the sag is infinitely steep.
    gap = (z - sag(shape, x, y)) * (1.0 if n is None else n[met, 2])
    assert (abs(gap) < 1e-13 * (1.0 + 0.1 * distance[met])).all()
    for origin, direction, t in zip(origins, directions, distance, strict=True):
        h = height(shape, origin, direction, samples)
        with np.errstate(invalid="ignore"):
            changes = np.flatnonzero(h[:-1] * h[1:] < 0.0)
        if changes.size:
            first, second = samples[changes[0] : changes[0] + 2]
            root = brentq(
                lambda s, o=origin, d=direction: float(height(shape, o, d, np.array([s]))[0]),
                first,
                second,
                xtol=1e-13,
            )
            # Before the first change of sign there may be two crossings between two samples.
            assert t < root + 1e-9, (shape, origin, direction)


@settings(max_examples=60, deadline=None)
@given(SEEDS)
def test_every_point_of_the_sheet_is_met(seed):
    """Up to its rim: a ray that starts 5 mm before a point of it crosses there, or earlier."""
    rng = np.random.default_rng(seed)
    shape = random_shape(rng)
    x, y = rng.uniform(-90.0, 90.0, (2, 200))
    place = np.column_stack([x, y, sag(shape, x, y)])
    place = place[np.isfinite(place[:, 2])]
    direction = rng.normal(size=place.shape)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    distance, _, n = meet(shape, place - 5.0 * direction, direction)
    # A ray that only grazes the surface may pass it by.
    clear = np.ones(len(place), bool) if n is None else ~(abs((n * direction).sum(axis=1)) < 1e-3)
    assert (distance[clear] <= 5.0 + 1e-9).all()


@settings(max_examples=40, deadline=None)
@given(SEEDS)
def test_normals_are_the_gradient_of_the_sag(seed):
    rng = np.random.default_rng(seed)
    shape = random_shape(rng)
    assume(not isinstance(shape, Plane))
    x, y = rng.uniform(-3.0, 3.0, (2, 30))
    step = 1e-5
    z = sag(shape, x, y)
    gradient = np.column_stack(
        [
            -(sag(shape, x + step, y) - sag(shape, x - step, y)) / (2.0 * step),
            -(sag(shape, x, y + step) - sag(shape, x, y - step)) / (2.0 * step),
            np.ones(30),
        ]
    )
    gradient /= np.linalg.norm(gradient, axis=1, keepdims=True)
    _, _, n = meet(shape, np.column_stack([x, y, z - 1.0]), np.tile(AHEAD, (30, 1)))
    np.testing.assert_allclose(n, gradient, rtol=0, atol=1e-8)


@pytest.mark.parametrize("radius", [12.0, -12.0, 1e3, 1e6, 1e9])
def test_a_sphere_is_met_to_the_last_digits_however_flat_or_far(radius):
    rng = np.random.default_rng(1)
    target = rng.uniform(-5.0, 5.0, (1000, 3))
    target[:, 2] = sag(Conic(radius), target[:, 0], target[:, 1])
    for far, limit in ((10.0, 2e-14), (1e4, 1e-11)):
        direction = np.column_stack([rng.uniform(-0.3, 0.3, (1000, 2)), np.ones(1000)])
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        origin = target - far * direction
        for shape in (Conic(radius), Toroid(radius, radius)):
            _, place, _ = meet(shape, origin, direction)
            gap = place[:, 2] - sag(shape, place[:, 0], place[:, 1])
            np.testing.assert_allclose(gap, 0.0, rtol=0, atol=2e-14)
            np.testing.assert_allclose(place, target, rtol=0, atol=limit)


@settings(max_examples=40, deadline=None)
@given(st.floats(0.05, 1.3), st.sampled_from([(1.0, 1.52), (1.52, 1.0), (1.33, 1.9)]))
def test_snell_and_the_path_through_a_plane(angle, indices):
    before, behind = indices
    stack = SurfaceStack(
        (Surface(Plane(), (0.0, 0.0, 2.0), index_behind=behind),), image_at(5.0), before
    )
    rays = trace_rays(stack, np.zeros((1, 3)), np.array([[0.0, np.sin(angle), np.cos(angle)]]))
    sine = before / behind * np.sin(angle)
    assume(abs(sine - 1.0) > 1e-6)
    if sine > 1.0:
        assert rays.status[0] == RayStatus.TOTALLY_REFLECTED
        assert rays.lost_at[0] == 0
        return
    cosine = np.sqrt(1.0 - sine**2)
    # A rounding of the sine is so much more of the cosine, near total reflection.
    limit = 3e-15 / cosine**2
    np.testing.assert_allclose(rays.direction[0], [0.0, sine, cosine], rtol=0, atol=limit)
    place = 2.0 * np.tan(angle) + 3.0 * sine / cosine
    np.testing.assert_allclose(rays.position_mm[0], [0.0, place, 0.0], rtol=limit)
    path = before * 2.0 / np.cos(angle) + behind * 3.0 / cosine
    np.testing.assert_allclose(rays.path_mm, path, rtol=limit)
    # In the plane of y and z: the plane of ray and x axis is across the plane of incidence.
    expected = transmittances(np.cos(angle), before, behind)
    np.testing.assert_allclose(rays.transmittance[0], expected, rtol=limit)


def test_two_faces_at_normal_incidence():
    faces = (Surface(Plane(), index_behind=1.52), Surface(Plane(), (0.0, 0.0, 4.0)))
    rays = trace_rays(SurfaceStack(faces, image_at(10.0)), np.array([[1.0, 2.0, -9.0]]), AHEAD)
    once = 1.0 - (0.52 / 2.52) ** 2
    np.testing.assert_allclose(rays.transmittance, once**2, rtol=1e-14)
    np.testing.assert_allclose(rays.path_mm, 9.0 + 4.0 * 1.52 + 6.0, rtol=1e-15)


@pytest.mark.slow
@settings(max_examples=20, deadline=None)
@given(SEEDS)
def test_polarisations_by_components_at_every_surface(seed):
    """Through any skew sequence: fields split into s and p at each face, with Fresnel's own t."""
    rng = np.random.default_rng(seed)
    stack = random_stack(rng)
    origins, directions = random_rays(rng, 50)
    rays = trace_rays(stack, origins, directions)
    for number in np.flatnonzero(rays.status == RayStatus.ARRIVED):
        o = origins[number]
        d = directions[number] / abs(directions[number]).max()
        d = d / np.linalg.norm(d)
        across = np.cross(d, [1.0, 0.0, 0.0])
        across /= np.linalg.norm(across)
        fields = [np.cross(across, d), across]
        power, before = np.ones(2), stack.index_in_front
        for surface in stack.surfaces:
            turn, behind = surface.rotation, surface.index_behind
            own = np.array([(o - surface.vertex_mm) @ turn])
            t, _, n = meet(surface.shape, own, np.array([d @ turn]))
            o = o + t[0] * d
            n = turn[:, 2] if n is None else turn @ n[0]
            n = n * np.sign(d @ n)
            if before == behind:
                continue
            across = np.cross(d, n)
            assume(np.linalg.norm(across) > 1e-6)
            s = across / np.linalg.norm(across)
            i = np.arctan2(np.linalg.norm(across), d @ n)
            r = np.arcsin(before / behind * np.sin(i))
            out = np.cos(r) * n + np.sin(r) * np.cross(n, s)
            t_s = 2.0 * np.sin(r) * np.cos(i) / np.sin(i + r)
            t_p = t_s / np.cos(i - r)
            fields = [
                t_s * (e @ s) * s + t_p * (e @ np.cross(d, s)) * np.cross(out, s) for e in fields
            ]
            power = power * behind * np.cos(r) / (before * np.cos(i))
            d, before = out, behind
        np.testing.assert_allclose(
            d @ stack.image.rotation, rays.direction[number], rtol=0, atol=1e-9
        )
        expected = power * [e @ e for e in fields]
        np.testing.assert_allclose(rays.transmittance[number], expected, rtol=0, atol=1e-8)


@pytest.mark.parametrize("outline", ["rectangular", "elliptical"])
def test_openings_are_in_the_frame_of_their_surface(outline):
    opening = Aperture(4.0, 2.0, outline)
    turned = Surface(Plane(), (1.0, 0.0, 5.0), (0.0, 0.0, np.pi / 2), aperture=opening)
    stack = SurfaceStack((turned,), image_at(9.0))
    origins = np.array([[1.0, 1.99, 0.0], [1.99, 0.0, 0.0], [1.0, 2.01, 0.0], [2.01, 0.0, 0.0],
                        [1.9, 1.9, 0.0]])  # fmt: skip
    rays = trace_rays(stack, origins, np.tile(AHEAD, (5, 1)))
    stopped = [0, 0, 2, 2, 0 if outline == "rectangular" else 2]
    np.testing.assert_array_equal(rays.status, stopped)
    np.testing.assert_array_equal(rays.lost_at, [0 if s else -1 for s in stopped])
    np.testing.assert_array_equal(rays.transmittance[rays.status == 0], 1.0)


def test_only_crossings_ahead_count():
    stack = SurfaceStack((Surface(Conic(20.0)),), image_at(50.0))
    origins = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0], [0.0, 0.0, 0.0]])
    rays = trace_rays(stack, origins, np.tile(AHEAD, (3, 1)))
    # From behind the vertex there is only the far half of the sphere, which is no part of it.
    np.testing.assert_array_equal(rays.status, [RayStatus.MISSED, 0, 0])
    assert rays.lost_at[0] == 0
    backwards = trace_rays(stack, np.array([[0.0, 0.0, -1.0]]), -AHEAD)
    assert backwards.status[0] == RayStatus.MISSED
    past = trace_rays(SurfaceStack((), image_at(-1.0)), np.zeros((1, 3)), AHEAD)
    assert (past.status[0], past.lost_at[0]) == (RayStatus.MISSED, 0)


def test_surfaces_that_touch_are_met_one_after_another():
    """A stop against the plane face of a tilted lens: between them there is only rounding."""
    tilt, back = (0.1, 0.2, 0.3), (0.5, -0.3, 4.0)
    lens = (
        Surface(Cylinder(16.54), (0.0, 0.0, -0.5), tilt, index_behind=1.52),
        Surface(Plane(), back, tilt),
    )
    stop = Surface(Plane(), back, tilt, aperture=Aperture(4.0, 4.0, "elliptical"))
    rng = np.random.default_rng(2)
    target = np.column_stack([rng.uniform(-1.5, 1.5, (1000, 2)), np.zeros(1000)])
    origin = np.array([70.0, -40.0, -333.3])
    rays = trace_rays(
        SurfaceStack((*lens, stop), image_at(37.0)), np.tile(origin, (1000, 1)), target - origin
    )
    assert set(rays.status) <= {RayStatus.ARRIVED, RayStatus.STOPPED}
    assert (rays.status == RayStatus.ARRIVED).sum() > 500


def test_a_ray_along_x_has_its_polarisations_too():
    image = Surface(Plane(), (5.0, 0.0, 0.0), (0.0, np.pi / 2, 0.0))
    glass = Surface(Plane(), (2.0, 0.0, 0.0), (0.0, np.pi / 2, 0.0), index_behind=1.52)
    rays = trace_rays(SurfaceStack((glass,), image), np.zeros((1, 3)), np.array([[3.0, 0.0, 0.0]]))
    np.testing.assert_allclose(rays.transmittance, 1.0 - (0.52 / 2.52) ** 2, rtol=1e-14)


def test_lengths_of_directions_are_nothing_even_at_the_ends_of_the_range():
    rng = np.random.default_rng(5)
    stack = random_stack(rng, most=3)
    origins, directions = random_rays(rng, 50)
    directions /= abs(directions).max(axis=1, keepdims=True)
    expected = trace_rays(stack, origins, directions)
    for scale in (2.0**-1000, 2.0**-20, 2.0**1000):
        assert_same_rays(trace_rays(stack, origins, directions * scale), expected)


def test_parts_of_many_rays_are_as_the_whole():
    rng = np.random.default_rng(6)
    stack = random_stack(rng)
    origins, directions = random_rays(rng, 2 * CHUNK_RAYS + 7)
    whole = trace_rays(stack, origins, directions)
    assert_consistent(whole)
    for part in (slice(0, 0), slice(CHUNK_RAYS - 1, CHUNK_RAYS + 1), slice(-1, None)):
        found = trace_rays(stack, origins[part], directions[part])
        np.testing.assert_array_equal(found.path_mm, whole.path_mm[part])
        np.testing.assert_array_equal(found.transmittance, whole.transmittance[part])
        np.testing.assert_array_equal(found.lost_at, whole.lost_at[part])


@pytest.mark.parametrize(
    ("origins", "directions", "match"),
    [
        (np.zeros(3), np.ones((1, 3)), r"origins_mm has the shape \(3,\); it must be \(N, 3\)"),
        (np.zeros((1, 3)), np.ones((1, 2)), r"directions has the shape \(1, 2\)"),
        (np.zeros((2, 3)), np.ones((1, 3)), "directions has 1 rows and origins_mm 2"),
        (np.full((1, 3), np.nan), np.ones((1, 3)), "origins_mm of ray 0 is .*finite"),
        (np.zeros((2, 3)), np.array([[0, 0, 1], [0, np.inf, 1]]), "directions of ray 1 is"),
        (np.zeros((1, 3)), np.zeros((1, 3)), "directions of ray 0 is zero"),
    ],
)
def test_refuses_what_is_no_ray(origins, directions, match):
    with pytest.raises(InvalidParameter, match=match):
        trace_rays(SurfaceStack((), image_at(1.0)), origins, directions)
