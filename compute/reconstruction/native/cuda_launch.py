"""CudaLaunch: launches of the point kernel on CUDA, with copies or without."""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from compute.reconstruction.point_batch import PointBatch
from compute.warp_host import host_memory

Array = NDArray[np.float64]

DIRECT_POINTS: Final = 4096
"""Largest batch that stays in the host's memory, which CUDA reads and writes directly: starting
the copies takes longer."""
POINTS_PER_LAUNCH: Final = 1 << 18
"""Most points in the buffers on CUDA; of more, one part after another is brought there."""
THREADS_PER_BLOCK: Final = 64
MOVED_WORDS: Final = 8
"""Addresses of a job that change from batch to batch, the first of its record."""


class CudaLaunch:
    """Runs the triangulation kernel on a CUDA device, in buffers of its own.

    Args:
        wp: the module Warp.
        kernel: as of ``point_kernel``.
        job: a JOB with all that stays the same.
        sensors: number of sensors.
        device: Warp's.
    """

    def __init__(
        self, wp: Any, kernel: Any, job: NDArray[np.void], sensors: int, device: Any
    ) -> None:
        self.most = POINTS_PER_LAUNCH
        """Points of one upload."""
        self._wp = wp
        self._device = device
        self._sensors = sensors
        self._job = job
        self._kernel = kernel
        self._direct = self._buffers(DIRECT_POINTS, pinned=True)
        self._direct_host = [host_memory(array) for array in self._direct]
        self._direct_launch = self._recorded(self._direct)
        self._staged: list[Any] = []
        self._staged_host: list[NDArray[Any]] = []
        self._there: list[Any] = []
        self._launch: Any = None
        self._capacity = 0
        self._uploaded = 0

    def solve(self, readings: Array, sigma: Array) -> PointBatch:
        """Triangulate N points.

        Args:
            readings: shape (N, S) [px], C-contiguous; NaN where not seen.
            sigma: their standard deviations, shape (N, S) [px], C-contiguous.
        """
        count = len(readings)
        if count <= DIRECT_POINTS:
            host = self._direct_host
            host[0][: readings.size] = readings.reshape(-1)
            host[1][: sigma.size] = sigma.reshape(-1)
            self._direct_launch.set_dim(count)
            self._direct_launch.launch()
            self._wp.synchronize_stream(self._device)
            points = PointBatch.zeros(count, self._sensors)
            self._collect(host, points, 0, count)
            return points
        points = PointBatch.zeros(count, self._sensors)
        for first in range(0, count, POINTS_PER_LAUNCH):
            end = min(first + POINTS_PER_LAUNCH, count)
            self.upload(readings[first:end], sigma[first:end])
            self.launch()
            self._download()
            self._collect(self._staged_host, points, first, end)
        return points

    def upload(self, readings: Array, sigma: Array) -> None:
        """Copy the readings of up to POINTS_PER_LAUNCH points to the device.

        Args:
            readings: shape (N, S) [px].
            sigma: their standard deviations, shape (N, S) [px].
        """
        self._reserve(len(readings))
        self._uploaded = len(readings)
        for index, array in enumerate((readings, sigma)):
            self._staged_host[index][: array.size] = array.reshape(-1)
            self._wp.copy(self._there[index], self._staged[index], count=array.size)

    def launch(self) -> None:
        """Start the kernel on the uploaded readings."""
        self._launch.set_dim(self._uploaded)
        self._launch.launch()

    def wait(self) -> None:
        """Wait for the kernel, without its results; to time it alone."""
        self._wp.synchronize_stream(self._device)

    def _download(self) -> None:
        for index, size in enumerate(self._sizes(self._uploaded)):
            if index >= 2:
                self._wp.copy(self._staged[index], self._there[index], count=size)
        self.wait()

    def _collect(self, host: list[NDArray[Any]], points: PointBatch, first: int, end: int) -> None:
        for source, target in zip(host[2:], vars(points).values(), strict=True):
            part = target[first:end]
            part[...] = source[: part.size].reshape(part.shape)

    def _sizes(self, count: int) -> list[int]:
        """Return the number of values of each array, for ``count`` points."""
        return [count * n for n in (self._sensors, self._sensors, 3, 9, 1, 1, self._sensors, 1)]

    def _buffers(self, count: int, *, pinned: bool) -> list[Any]:
        wp = self._wp
        types = [wp.float64] * 6 + [wp.uint8, wp.int32]
        device = "cpu" if pinned else self._device
        return [
            wp.zeros(size, dtype=dtype, device=device, pinned=pinned)
            for size, dtype in zip(self._sizes(count), types, strict=True)
        ]

    def _recorded(self, buffers: list[Any]) -> Any:
        """Return a launch whose job has the addresses of these buffers."""
        wp, job = self._wp, self._job.copy()
        words = job.view(np.uint64)
        words[:MOVED_WORDS] = [array.ptr for array in buffers]
        there = wp.array(words, dtype=wp.uint64, device=self._device)
        launch = wp.launch(
            self._kernel,
            dim=1,
            inputs=[there.ptr],
            device=self._device,
            block_dim=THREADS_PER_BLOCK,
            record_cmd=True,
        )
        # Kept: the launch has its address.
        launch.job = there
        return launch

    def _reserve(self, count: int) -> None:
        """Make the buffers large enough; they only grow."""
        if count <= self._capacity:
            return
        self._capacity = min(max(count, 2 * self._capacity), POINTS_PER_LAUNCH)
        self._there = self._buffers(self._capacity, pinned=False)
        self._staged = self._buffers(self._capacity, pinned=True)
        self._staged_host = [host_memory(array) for array in self._staged]
        self._launch = self._recorded(self._there)
