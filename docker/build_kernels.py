"""Builds the kernels that the service loads, into Warp's cache (WARP_CACHE_PATH).

Usage: build_kernels.py [GPU_ARCHITECTURE...]. Without one, for the CPU that this runs on.
"""

import sys
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
    from compute.optics.tracing.ray_kernel import ray_kernel
    from compute.optics.tracing.ray_tracer import THREADS_PER_BLOCK as RAYS
    from compute.pose.filtering.native.kernel_arguments import step_kernel
    from compute.pose.filtering.native.pose_reliability import reliability_kernel
    from compute.reconstruction.native.cuda_launch import THREADS_PER_BLOCK as POINTS
    from compute.reconstruction.solver import MIN_CAPACITY, point_kernel
    from compute.signal.native.definitions import BLOCK_THREADS
    from compute.signal.native.scan_kernel import Search, scan_kernel

    for search in get_args(Search):
        for corrected in (False, True):
            yield scan_kernel(search, corrected).module, BLOCK_THREADS
    for has_toroids in (False, True):
        yield ray_kernel(has_toroids).module, RAYS
    for sensors in SENSORS:
        for room in (0, MIN_CAPACITY):
            yield point_kernel(sensors, room).module, POINTS
            yield step_kernel(sensors, room).module, 0
            yield reliability_kernel(sensors, room).module, 0


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
