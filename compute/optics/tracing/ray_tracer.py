"""Ray tracer by Warp for many rays through one stack of surfaces, on one device."""

from typing import Any, Final

import numpy as np

from compute.optics.tracing.reference_tracer import RayStatus, TracedRays, validate_rays
from compute.optics.tracing.surface_records import Form, pack
from compute.optics.tracing.surfaces import Array, SurfaceStack
from compute.warp_host import host_memory, warp_device

INPUTS: Final = 6
"""Numbers of a ray: origin and direction."""
OUTPUTS: Final = 8.5
"""Float64 words of a result: x, y, direction, path, two transmittances, an int32."""
MIN_RAYS: Final = 1024
THREADS_PER_BLOCK: Final = 64


class RayTracer:
    """Exact ray trace through a stack of surfaces by Warp; the results of ``trace_rays``.

    Warp is not thread-safe: one thread makes the tracer and calls it. Making it loads Warp and
    compiles the kernel, unless an earlier process has (seconds). The surfaces are data to the
    kernel: another stack needs no other kernel.

    Args:
        stack: the surfaces.
        device: "cpu", "cuda:0", ...; None takes the first CUDA device, or else the CPU.

    Raises:
        InvalidParameter: a device that is not there.
    """

    def __init__(self, stack: SurfaceStack, device: str | None = None) -> None:
        # Here and not above: Warp takes a second to load, and the types are used without it.
        import warp as wp

        from compute.optics.tracing.ray_kernel import ray_kernel

        self._wp = wp
        self.stack = stack
        self._device = warp_device(wp, device)
        self.device = str(self._device.alias)
        self._cuda = bool(self._device.is_cuda)
        records = pack(stack)
        toroids = bool((records["form"] == Form.TOROID).any())
        self._surfaces: Any = wp.array(records.view(np.uint8), dtype=wp.uint8, device=self._device)
        self._capacity = 0
        self._reserve(MIN_RAYS)
        self._uploaded = 0
        self._launch = wp.launch(
            ray_kernel(toroids),
            dim=1,
            inputs=[1, self._rays.ptr, self._surfaces.ptr, len(records) - 1, self._results.ptr],
            device=self._device,
            block_dim=THREADS_PER_BLOCK,
            record_cmd=True,
        )

    def trace(self, origins_mm: Array, directions: Array) -> TracedRays:
        """Trace rays to the image plane, as ``trace_rays`` does.

        Args:
            origins_mm: where the rays start, in the stack's frame, shape (N, 3) [mm].
            directions: their directions, of any length, shape (N, 3).

        Raises:
            InvalidParameter: shapes that do not fit, values not finite, directions of no length.
        """
        self.upload(origins_mm, directions)
        self.launch()
        return self.download()

    def upload(self, origins_mm: Array, directions: Array) -> None:
        """Copy rays to the device; ``trace`` is upload, launch and download.

        Args:
            origins_mm: where the rays start, in the stack's frame, shape (N, 3) [mm].
            directions: their directions, of any length, shape (N, 3).
        """
        origins, vectors = validate_rays(origins_mm, directions)
        count = len(origins)
        self._reserve(count)
        self._uploaded = count
        if count == 0:
            return
        words = self._host_rays[: INPUTS * count].reshape(INPUTS, count)
        words[:3], words[3:] = origins.T, vectors.T
        if self._cuda:
            self._wp.copy(self._rays, self._staged_rays, count=INPUTS * count)

    def launch(self) -> None:
        """Start the kernel on the rays uploaded."""
        if self._uploaded == 0:
            return
        self._launch.set_dim(self._uploaded)
        self._launch.set_param_at_index(0, self._uploaded)
        self._launch.set_param_at_index(1, self._rays.ptr)
        self._launch.set_param_at_index(4, self._results.ptr)
        self._launch.launch()

    def wait(self) -> None:
        """Wait for the kernel, without its results; to time it alone."""
        if self._cuda:
            self._wp.synchronize_stream(self._device)

    def download(self) -> TracedRays:
        """Wait for the kernel and return its results."""
        count = self._uploaded
        if self._cuda and count:
            self._wp.copy(self._staged_results, self._results, count=_words(count))
            self._wp.synchronize_stream(self._device)
        words = self._host_results[: 8 * count].reshape(8, count)
        codes = self._host_results[8 * count : _words(count)].view(np.int32)[:count]
        position = np.zeros((count, 3))
        position[:, :2] = words[:2].T
        status = (codes & 3).astype(np.int32)
        arrived = status == RayStatus.ARRIVED
        position[:, 2] = np.where(arrived, 0.0, np.nan)
        return TracedRays(
            position_mm=position,
            direction=np.ascontiguousarray(words[2:5].T),
            path_mm=words[5].copy(),
            transmittance=np.ascontiguousarray(words[6:8].T),
            status=status,
            lost_at=np.where(arrived, -1, codes >> 2).astype(np.int32),
        )

    def _reserve(self, count: int) -> None:
        """Make the buffers large enough; they only grow."""
        if count <= self._capacity:
            return
        wp = self._wp
        self._capacity = max(count, 2 * self._capacity)
        rays, results = INPUTS * self._capacity, _words(self._capacity)
        self._rays = wp.zeros(rays, dtype=wp.float64, device=self._device)
        self._results = wp.zeros(results, dtype=wp.float64, device=self._device)
        self._staged_rays, self._staged_results = self._rays, self._results
        if self._cuda:
            self._staged_rays = wp.zeros(rays, dtype=wp.float64, device="cpu", pinned=True)
            self._staged_results = wp.zeros(results, dtype=wp.float64, device="cpu", pinned=True)
        self._host_rays = host_memory(self._staged_rays)
        self._host_results = host_memory(self._staged_results)


def _words(count: int) -> int:
    """Return the number of float64 words of the results."""
    return int(np.ceil(OUTPUTS * count))
