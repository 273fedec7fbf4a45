"""The tracer on CUDA against NumPy; needs a CUDA device, and no plugin of pytest."""

import numpy as np
import pytest

from compute.optics.tracing.ray_tracer import RayTracer
from compute.optics.tracing.reference_tracer import RayStatus, trace_rays
from tests.compute.optics.tracing.ray_systems import assert_same_rays, random_rays, random_stack


@pytest.fixture(scope="module")
def device():
    import warp as wp

    if not wp.is_cuda_available():
        pytest.skip("no CUDA device")
    return "cuda:0"


@pytest.mark.parametrize("seed", range(60))
def test_matches_numpy(device, seed):
    rng = np.random.default_rng(seed)
    stack = random_stack(rng)
    rays = random_rays(rng, 20_000)
    found = RayTracer(stack, device).trace(*rays)
    assert_same_rays(found, trace_rays(stack, *rays))


def test_every_outcome_occurs(device):
    """So that the comparison above compares something."""
    seen = np.zeros(len(RayStatus), np.int64)
    for seed in range(60):
        rng = np.random.default_rng(seed)
        stack = random_stack(rng)
        status = RayTracer(stack, device).trace(*random_rays(rng, 20_000)).status
        seen += np.bincount(status, minlength=len(RayStatus))
    assert (seen > 10_000).all()


def test_buffers_grow_and_serve_fewer_rays(device):
    rng = np.random.default_rng(3)
    stack = random_stack(rng, most=2)
    tracer = RayTracer(stack, device)
    for count in (5000, 0, 1, 70_001, 33):
        rays = random_rays(rng, count)
        assert_same_rays(tracer.trace(*rays), trace_rays(stack, *rays))
