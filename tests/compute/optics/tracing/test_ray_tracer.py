"""The Warp kernel on the CPU against NumPy, over systems of any surfaces."""

from typing import get_args

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from compute.errors import InvalidParameter
from compute.optics.tracing.ray_tracer import RayTracer
from compute.optics.tracing.reference_tracer import RayStatus, trace_rays
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
from tests.compute.optics.tracing.ray_systems import (
    assert_consistent,
    assert_same_rays,
    random_rays,
    random_stack,
)

RADII = st.floats(5.0, 1e7) | st.floats(-1e7, -5.0) | st.floats(5.0, 60.0)
CONICS = st.floats(-4.0, 3.0)
INDICES = st.sampled_from([1.0, 1.33, 1.52, 1.9])
SHAPES = st.one_of(
    st.builds(Plane),
    st.builds(Conic, RADII, CONICS),
    st.builds(Cylinder, RADII, CONICS),
    st.builds(Toroid, RADII, RADII, CONICS),
)
TURNS = st.just((0.0, 0.0, 0.0)) | st.tuples(*[st.floats(-0.5, 0.5)] * 3)
APERTURES = st.none() | st.builds(
    Aperture,
    st.floats(2.0, 60.0),
    st.floats(2.0, 60.0) | st.just(np.inf),
    st.sampled_from(get_args(Outline)),
)


@st.composite
def stacks(draw):
    z = np.cumsum([0.0, *draw(st.lists(st.floats(0.0, 10.0), max_size=4))])
    off_axis = st.floats(-2.0, 2.0)
    surfaces = tuple(
        Surface(
            draw(SHAPES),
            (draw(off_axis), draw(off_axis), float(place)),
            draw(TURNS),
            draw(INDICES),
            draw(APERTURES),
        )
        for place in z[:-1]
    )
    image = Surface(Plane(), (0.0, 0.0, float(z[-1])), draw(TURNS))
    return SurfaceStack(surfaces, image, draw(INDICES))


@settings(max_examples=60, deadline=None)
@given(stacks(), st.integers(0, 2**32 - 1))
def test_matches_numpy(stack, seed):
    rays = random_rays(np.random.default_rng(seed), 400)
    expected = trace_rays(stack, *rays)
    assert_consistent(expected)
    assert_same_rays(RayTracer(stack, "cpu").trace(*rays), expected)


@pytest.mark.slow
def test_every_outcome_occurs_and_is_the_same():
    seen = np.zeros(len(RayStatus), np.int64)
    for seed in range(20):
        rng = np.random.default_rng(seed)
        stack = random_stack(rng)
        rays = random_rays(rng, 2000)
        expected = trace_rays(stack, *rays)
        assert_same_rays(RayTracer(stack, "cpu").trace(*rays), expected)
        seen += np.bincount(expected.status, minlength=len(RayStatus))
    assert (seen > 500).all()


def test_buffers_grow_and_serve_fewer_rays():
    rng = np.random.default_rng(3)
    stack = random_stack(rng, most=2)
    tracer = RayTracer(stack, "cpu")
    for count in (1500, 0, 1, 5001, 33):
        rays = random_rays(rng, count)
        found = tracer.trace(*rays)
        assert found.position_mm.shape == (count, 3)
        assert_same_rays(found, trace_rays(stack, *rays))


def test_results_stay_when_the_tracer_goes_on():
    rng = np.random.default_rng(4)
    tracer = RayTracer(random_stack(rng, most=2), "cpu")
    rays = random_rays(rng, 100)
    first = tracer.trace(*rays)
    kept = first.path_mm.copy()
    tracer.trace(*random_rays(rng, 100))
    np.testing.assert_array_equal(first.path_mm, kept)


def test_refuses_what_trace_rays_refuses():
    tracer = RayTracer(random_stack(np.random.default_rng(0)), "cpu")
    with pytest.raises(InvalidParameter, match="directions of ray 1 is zero"):
        tracer.trace(np.zeros((2, 3)), np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 0.0]]))


def test_refuses_a_device_that_is_not_there():
    with pytest.raises(InvalidParameter, match="there is no device 'abacus'; there are: cpu"):
        RayTracer(random_stack(np.random.default_rng(0)), "abacus")
