"""Warp kernels that trace rays, one thread a ray, on the CPU and on CUDA.

Only ``compute.optics.tracing.ray_tracer`` imports this module, when a tracer is made: it loads
Warp.
"""

from typing import Final

import warp as wp

from compute.native.headers import module_options

# Without fused multiply-adds, both devices round as NumPy does.
OPTIONS: Final = module_options("compute/optics/tracing/native/ray_tracing.h", fuse_fp=False)
_CALL: Final = (
    "lumiline::tracing::trace_ray<{}>"
    "(ray, rays, rays_address, surfaces_address, image, results_address);"
)


@wp.func_native(_CALL.format("true"))  # type: ignore[untyped-decorator]
def _trace_one_ray(
    ray: int,
    rays: int,
    rays_address: wp.uint64,
    surfaces_address: wp.uint64,
    image: int,
    results_address: wp.uint64,
) -> None: ...


@wp.func_native(_CALL.format("false"))  # type: ignore[untyped-decorator]
def _trace_one_ray_without_toroids(
    ray: int,
    rays: int,
    rays_address: wp.uint64,
    surfaces_address: wp.uint64,
    image: int,
    results_address: wp.uint64,
) -> None: ...


@wp.kernel(module="unique", module_options=OPTIONS)  # type: ignore[untyped-decorator]
def trace_rays(
    rays: int,
    rays_address: wp.uint64,
    surfaces_address: wp.uint64,
    image: int,
    results_address: wp.uint64,
) -> None:
    """Trace N = ``rays`` rays; launch with as many threads.

    ``rays_address`` is that of float64 (6, N) in the device's memory: origin and direction, of
    any length. ``surfaces_address`` is that of SURFACE_RECORDs, the last of which, number
    ``image``, is the image plane. ``results_address`` is that of float64 (8, N): x, y, direction,
    path, both transmittances; then of int32 (N,): 4 times the surface plus the status.
    """
    _trace_one_ray(wp.tid(), rays, rays_address, surfaces_address, image, results_address)


@wp.kernel(module="unique", module_options=OPTIONS)  # type: ignore[untyped-decorator]
def trace_rays_without_toroids(
    rays: int,
    rays_address: wp.uint64,
    surfaces_address: wp.uint64,
    image: int,
    results_address: wp.uint64,
) -> None:
    """Trace rays as ``trace_rays`` does, through surfaces none of which is a toroid."""
    _trace_one_ray_without_toroids(
        wp.tid(), rays, rays_address, surfaces_address, image, results_address
    )
