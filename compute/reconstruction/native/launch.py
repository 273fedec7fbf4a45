"""Launches of the point kernel: on the CPU in threads, on CUDA with copies or without."""

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from compute.reconstruction.native.kernel_arguments import JOB
from compute.reconstruction.point_batch import PointBatch
from compute.warp_host import check_threads, host_memory, worker_threads

Array = NDArray[np.float64]

POINTS_PER_THREAD: Final = 512
"""A further CPU thread must have so many points to be worth it."""
DIRECT_POINTS: Final = 4096
"""Batches up to so many points stay in the host's memory, where CUDA reads them once and writes the
points: the copies' starts take longer than that."""
POINTS_PER_LAUNCH: Final = 1 << 18
"""Most points in the buffers on CUDA; of more, one part after another is brought there."""
THREADS_PER_BLOCK: Final = 64
POINT_BYTES: Final = 108
"""A point's position, covariance, chi2 and flags."""
_MOVING: Final = 7
"""Addresses of a job that change from batch to batch, the first of its record."""


def address(array: NDArray[Any]) -> int:
    """Return where an array's memory begins."""
    return int(array.__array_interface__["data"][0])


def empty_points(count: int, sensors: int) -> PointBatch:
    """Return a batch to be filled; its arrays lie one after another in one block of memory."""
    block = np.empty(count * (POINT_BYTES + sensors), dtype=np.uint8)
    return PointBatch(
        np.ndarray((count, 3), np.float64, block),
        np.ndarray((count, 3, 3), np.float64, block, 24 * count),
        np.ndarray((count,), np.float64, block, 96 * count),
        np.ndarray((count, sensors), np.bool_, block, POINT_BYTES * count),
        np.ndarray((count,), np.int32, block, 104 * count),
    )


class CpuLaunch:
    """Runs the kernel on arrays where they are; large batches are shared by threads.

    Args:
        wp: the module Warp.
        kernel: as of ``point_kernel``.
        job: a JOB with all that stays the same.
        sensors: number of sensors.
        threads: most threads; None: as many as there are CPUs.
    """

    def __init__(
        self, wp: Any, kernel: Any, job: NDArray[np.void], sensors: int, threads: int | None
    ) -> None:
        self._sensors = sensors
        self._threads = check_threads(threads)
        self._jobs = np.repeat(job, self._threads)
        self._words = self._jobs.view(np.uint64).reshape(self._threads, -1)
        self._counts = [1] * self._threads
        first = address(self._jobs)
        self._launches = [
            wp.launch(
                kernel,
                dim=1,
                inputs=[first + thread * JOB.itemsize],
                device="cpu",
                record_cmd=True,
            )
            for thread in range(self._threads)
        ]

    def solve(self, readings: Array, sigma: Array) -> PointBatch:
        """Return the points of readings (N, S) and their standard deviations, C-contiguous."""
        count, sensors = len(readings), self._sensors
        points = empty_points(count, sensors)
        base = address(points.position_mm)
        addresses = (
            address(readings),
            address(sigma),
            base,
            base + 24 * count,
            base + 96 * count,
            base + POINT_BYTES * count,
            base + 104 * count,
        )
        parts = max(min(self._threads, count // POINTS_PER_THREAD), 1)
        if parts == 1:
            self._prepare(0, addresses, count)
            self._launches[0].launch()
            return points
        strides = (8 * sensors, 8 * sensors, 24, 72, 8, sensors, 4)
        starts = [count * part // parts for part in range(parts + 1)]
        for part in range(parts):
            moved = [
                at + starts[part] * stride for at, stride in zip(addresses, strides, strict=True)
            ]
            self._prepare(part, moved, starts[part + 1] - starts[part])
        # Warp is not thread-safe, but all that a helper calls is the compiled kernel.
        pending = [worker_threads().submit(launch.launch) for launch in self._launches[1:parts]]
        self._launches[0].launch()
        for future in pending:
            future.result()
        return points

    def _prepare(self, part: int, addresses: Sequence[int], count: int) -> None:
        self._words[part, :_MOVING] = addresses
        # It takes as long as a few points.
        if self._counts[part] != count:
            self._counts[part] = count
            self._launches[part].set_dim(count)


class CudaLaunch:
    """Runs the kernel on a CUDA device, in buffers of its own.

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
        """Return the points of readings (N, S) and their standard deviations, C-contiguous."""
        count = len(readings)
        if count <= DIRECT_POINTS:
            host = self._direct_host
            host[0][: readings.size] = readings.reshape(-1)
            host[1][: sigma.size] = sigma.reshape(-1)
            self._direct_launch.set_dim(count)
            self._direct_launch.launch()
            self._wp.synchronize_stream(self._device)
            points = empty_points(count, self._sensors)
            self._collect(host, points, 0, count)
            return points
        points = empty_points(count, self._sensors)
        for first in range(0, count, POINTS_PER_LAUNCH):
            end = min(first + POINTS_PER_LAUNCH, count)
            self.upload(readings[first:end], sigma[first:end])
            self.launch()
            self._download()
            self._collect(self._staged_host, points, first, end)
        return points

    def upload(self, readings: Array, sigma: Array) -> None:
        """Bring up to POINTS_PER_LAUNCH readings to the device."""
        self._reserve(len(readings))
        self._uploaded = len(readings)
        for index, array in enumerate((readings, sigma)):
            self._staged_host[index][: array.size] = array.reshape(-1)
            self._wp.copy(self._there[index], self._staged[index], count=array.size)

    def launch(self) -> None:
        """Start the kernel on what was uploaded."""
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
        filled: list[NDArray[Any]] = [
            points.position_mm,
            points.covariance_mm2,
            points.chi2,
            points.used,
            points.flags,
        ]
        for source, target in zip(host[2:], filled, strict=True):
            part = target[first:end]
            part[...] = source[: part.size].reshape(part.shape)

    def _sizes(self, count: int) -> list[int]:
        """Return how many values of each array so many points have."""
        return [count * n for n in (self._sensors, self._sensors, 3, 9, 1, self._sensors, 1)]

    def _buffers(self, count: int, *, pinned: bool) -> list[Any]:
        wp = self._wp
        types = [wp.float64] * 5 + [wp.uint8, wp.int32]
        device = "cpu" if pinned else self._device
        return [
            wp.zeros(size, dtype=dtype, device=device, pinned=pinned)
            for size, dtype in zip(self._sizes(count), types, strict=True)
        ]

    def _recorded(self, buffers: list[Any]) -> Any:
        """Return a launch whose job has the addresses of these buffers."""
        wp, job = self._wp, self._job.copy()
        words = job.view(np.uint64)
        words[:_MOVING] = [array.ptr for array in buffers]
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
