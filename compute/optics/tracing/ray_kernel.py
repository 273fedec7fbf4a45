"""Warp kernels that trace rays, one thread a ray, on the CPU and on CUDA.

Only ``compute.optics.tracing.ray_tracer`` imports this module, when a tracer is made: it loads
Warp.
"""

from functools import cache
from typing import Any

import warp as wp

from compute.native.headers import module_options


@cache
def ray_kernel(has_toroids: bool) -> Any:
    """Return the kernel for surfaces with or without toroids; launch with one thread a ray.

    It takes the number N of rays; the address in the device's memory of float64 (6, N), origin
    and direction of any length; the address of SURFACE_RECORDs and the number of the last one,
    the image plane; and the address of float64 (8, N): x, y, direction, path, both
    transmittances; then of int32 (N,): 4 times the surface plus the status.
    """

    def trace_ray(
        ray: int,
        rays: int,
        rays_address: wp.uint64,
        surfaces_address: wp.uint64,
        image: int,
        results_address: wp.uint64,
    ) -> None: ...

    native = wp.func_native(
        f"lumiline::tracing::trace_ray<{str(has_toroids).lower()}>"
        "(ray, rays, rays_address, surfaces_address, image, results_address);"
    )(trace_ray)

    def trace_rays(
        rays: int,
        rays_address: wp.uint64,
        surfaces_address: wp.uint64,
        image: int,
        results_address: wp.uint64,
    ) -> None:
        native(wp.tid(), rays, rays_address, surfaces_address, image, results_address)

    # Without fused multiply-adds, both devices round as NumPy does.
    options = module_options("compute/optics/tracing/native/ray_tracing.h", fuse_fp=False)
    return wp.kernel(module="unique", module_options=options)(trace_rays)
