"""Systems of random surfaces and rays at them, and how two tracers' results are compared."""

from typing import get_args

import numpy as np

from compute.optics.tracing.reference_tracer import RayStatus
from compute.optics.tracing.surfaces import (
    Aperture,
    Conic,
    Cylinder,
    Outline,
    Plane,
    Surface,
    SurfaceStack,
    Toroid,
)


def random_shape(rng):
    radius, other = rng.choice([-1.0, 1.0], 2) * rng.uniform(8.0, 80.0, 2)
    conic = rng.uniform(-2.5, 1.5)
    return [
        Plane(),
        Conic(radius, conic),
        Cylinder(radius, conic),
        Toroid(radius, other, conic),
        Conic(radius * 1e6),
        Cylinder(other),
        Toroid(radius, other * 1e5, conic),
        Toroid(radius * 1e5, other, conic),
    ][rng.integers(8)]


def random_stack(rng, most=6):
    z = 0.0
    surfaces = []
    for _ in range(rng.integers(0, most + 1)):
        z += rng.uniform(0.0, 8.0)
        aperture = None
        if rng.random() < 0.7:
            width, height = rng.uniform(6.0, 40.0, 2)
            aperture = Aperture(width, height, get_args(Outline)[rng.integers(2)])
        surfaces.append(
            Surface(
                random_shape(rng),
                (rng.normal(0.0, 0.5), rng.normal(0.0, 0.5), z),
                tuple(rng.normal(0.0, 0.2, 3) * (rng.random() < 0.6)),
                rng.choice([1.0, 1.33, 1.52, 1.9]),
                aperture,
            )
        )
    tilt = tuple(rng.normal(0.0, 0.2, 3) * (rng.random() < 0.5))
    image = Surface(Plane(), (0.1, -0.2, z + rng.uniform(1.0, 40.0)), tilt)
    return SurfaceStack(tuple(surfaces), image, rng.choice([1.0, 1.33]))


def random_rays(rng, count):
    """Half from afar at the first surface, half from close by in any direction."""
    half = count // 2
    target = np.column_stack([rng.uniform(-15.0, 15.0, (half, 2)), rng.normal(0.0, 2.0, half)])
    origin = rng.normal(0.0, 300.0, (half, 3))
    origin[:, 2] = -np.exp(rng.uniform(0.0, np.log(1e4), half))
    near = rng.normal(0.0, 10.0, (count - half, 3))
    # Lengths of directions are nothing to a tracer.
    lengths = np.exp(rng.uniform(-400.0, 400.0, (count, 1)))
    directions = np.concatenate([target - origin, rng.normal(size=(count - half, 3))])
    return np.concatenate([origin, near]), directions * lengths


def assert_same_rays(found, expected):
    np.testing.assert_array_equal(found.status, expected.status)
    np.testing.assert_array_equal(found.lost_at, expected.lost_at)
    for name, limit in (
        ("position_mm", 1e-12),
        ("direction", 1e-14),
        ("path_mm", 1e-11),
        ("transmittance", 1e-13),
    ):
        ours, theirs = getattr(found, name), getattr(expected, name)
        assert ours.dtype == theirs.dtype
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=limit, err_msg=name)


def assert_consistent(rays):
    """What is true of all results: arrived or NaN, light only lost."""
    arrived = rays.status == RayStatus.ARRIVED
    for values in (rays.position_mm, rays.direction, rays.path_mm[:, None]):
        np.testing.assert_array_equal(np.isfinite(values).all(axis=1), arrived)
        assert np.isnan(values[~arrived]).all()
    np.testing.assert_array_equal(rays.lost_at == -1, arrived)
    assert not rays.transmittance[~arrived].any()
    assert ((rays.transmittance >= 0.0) & (rays.transmittance <= 1.0 + 1e-12)).all()
    assert not rays.position_mm[arrived, 2].any()
    np.testing.assert_allclose(
        np.linalg.norm(rays.direction[arrived], axis=1), 1.0, rtol=0, atol=1e-14
    )
