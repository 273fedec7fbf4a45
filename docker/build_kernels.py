"""Builds the kernels that the service loads, into Warp's cache (WARP_CACHE_PATH).

Usage: build_kernels.py [GPU_ARCHITECTURE...]. Without one, for the CPU that this runs on.
"""

import sys
import types
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import Any, get_args

SENSORS = (3, 4, 5, 6)
"""Devices with another number of sensors have their kernel built at their first start."""


def modules() -> Iterator[tuple[Any, int]]:
    """Yield every module with the size of the blocks that it is launched with on a GPU; 0: never.

    Tools are followed by the CPU, whatever there is beside it.
    """
    import warp as wp

    from compute.optics.tracing import ray_kernel as tracing
    from compute.optics.tracing.ray_tracer import THREADS_PER_BLOCK as RAYS
    from compute.pose.filtering.native.strobed_step import step_kernel
    from compute.reconstruction.native.cuda_launch import THREADS_PER_BLOCK as POINTS
    from compute.reconstruction.native.kernel import point_kernel
    from compute.reconstruction.solver import MIN_CAPACITY
    from compute.signal.fit import fit_kernel
    from compute.signal.native.centroid_kernel import centroid_kernel
    from compute.signal.native.centroid_source import Length
    from compute.signal.native.cuda_launch_sizes import BLOCK_THREADS

    assert isinstance(fit_kernel, types.ModuleType)
    yield wp.get_module(fit_kernel.__name__), BLOCK_THREADS
    for length in get_args(Length)[:3]:
        yield centroid_kernel(length).module, BLOCK_THREADS
    yield tracing.trace_rays.module, RAYS
    yield tracing.trace_rays_without_toroids.module, RAYS
    for sensors in SENSORS:
        for room in (0, MIN_CAPACITY):
            yield point_kernel(sensors, room).module, POINTS
            yield step_kernel(sensors, room).module, 0


def build(number: int, architectures: tuple[int, ...]) -> str:
    """Build one of them and return its name."""
    import warp as wp

    module, block = tuple(modules())[number]
    wp.init()  # behind the imports, which keep it from greeting
    if architectures and block:
        module.options["block_dim"] = block
        wp.compile_aot_module(module, arch=architectures)
    else:
        module.load("cpu", block_dim=1)
    return str(module.name)


def main() -> None:
    """Build all of them, as many at once as there are CPUs."""
    architectures = tuple(int(text) for text in sys.argv[1:])
    count = sum(1 for _ in modules())
    # Spawned: what Warp and numpy have begun in this process is nothing to fork.
    with ProcessPoolExecutor(mp_context=get_context("spawn")) as pool:
        for name in pool.map(build, range(count), [architectures] * count):
            sys.stdout.write(f"built {name}\n")


if __name__ == "__main__":
    main()
