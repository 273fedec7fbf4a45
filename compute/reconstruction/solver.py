"""PointSolver: triangulation by one native kernel, for one calibration on one device."""

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from compute.camera.model import SensorModel
from compute.camera.stack import CameraStack
from compute.errors import InvalidParameter
from compute.mapping.table import CorrectionTable
from compute.measurement.measurement_model import check_calibration
from compute.reconstruction.native.cuda_launch import MOVED_WORDS, THREADS_PER_BLOCK, CudaLaunch
from compute.reconstruction.native.definitions import JOB, MAX_POWER, fill_cameras, row_length
from compute.reconstruction.point_batch import PointBatch
from compute.reconstruction.triangulation import chi2_limits, noncentralities
from compute.warp_host import (
    PackedLaunch,
    address,
    check_threads,
    warp_device,
    worker_threads,
)

Array = NDArray[np.float64]

MAX_SENSORS: Final = 64
MIN_CAPACITY: Final = 16
"""Terms of distortion that a kernel has room for, at least, when it has any: calibrations with
other terms then need no other kernel."""
POINTS_PER_THREAD: Final = 512
"""Fewest points for which another CPU thread is worth its start."""
_POINT_BYTES: Final = 116
"""Bytes of a point's position, covariance, chi2, external reliability and flags."""


class CpuLaunch:
    """Runs the triangulation kernel on arrays in place; threads share large batches.

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
            PackedLaunch(
                wp.launch(
                    kernel,
                    dim=1,
                    inputs=[first + thread * JOB.itemsize],
                    device="cpu",
                    record_cmd=True,
                )
            )
            for thread in range(self._threads)
        ]

    def solve(self, readings: Array, sigma: Array) -> PointBatch:
        """Triangulate N points.

        Args:
            readings: shape (N, S) [px], C-contiguous; NaN where not seen.
            sigma: their standard deviations, shape (N, S) [px], C-contiguous.
        """
        count, sensors = len(readings), self._sensors
        # One block of memory: one address, from which the others follow.
        block = np.empty(count * (_POINT_BYTES + sensors), dtype=np.uint8)
        points = PointBatch(
            np.ndarray((count, 3), np.float64, block),
            np.ndarray((count, 3, 3), np.float64, block, 24 * count),
            np.ndarray((count,), np.float64, block, 96 * count),
            np.ndarray((count,), np.float64, block, 104 * count),
            np.ndarray((count, sensors), np.bool_, block, _POINT_BYTES * count),
            np.ndarray((count,), np.int32, block, 112 * count),
        )
        base = address(block)
        addresses = (
            address(readings),
            address(sigma),
            base,
            base + 24 * count,
            base + 96 * count,
            base + 104 * count,
            base + _POINT_BYTES * count,
            base + 112 * count,
        )
        parts = max(min(self._threads, count // POINTS_PER_THREAD), 1)
        if parts == 1:
            self._prepare(0, addresses, count)
            self._launches[0].run()
            return points
        strides = (8 * sensors, 8 * sensors, 24, 72, 8, 8, sensors, 4)
        starts = [count * part // parts for part in range(parts + 1)]
        for part in range(parts):
            moved = [
                at + starts[part] * stride for at, stride in zip(addresses, strides, strict=True)
            ]
            self._prepare(part, moved, starts[part + 1] - starts[part])
        # Warp is not thread-safe, but all that a helper calls is the compiled kernel.
        pending = [worker_threads().submit(launch.run) for launch in self._launches[1:parts]]
        self._launches[0].run()
        for future in pending:
            future.result()
        return points

    def _prepare(self, part: int, addresses: Sequence[int], count: int) -> None:
        self._words[part, :MOVED_WORDS] = addresses
        # It takes as long as a few points.
        if self._counts[part] != count:
            self._counts[part] = count
            self._launches[part].set_dim(count)


class PointSolver:
    """Triangulation as ``reconstruct`` does it, in float64, by one kernel on the CPU or on CUDA.

    Warp is not thread-safe: one thread makes the solver and calls it. Making it loads Warp and
    compiles the kernel for this number of sensors, with distortion or without, unless an earlier
    process has (seconds); ``solve`` does neither. Cameras, covariance and table are data to it:
    a solver for another calibration of the same device is made in a millisecond.

    Args:
        cameras: S calibrated cameras.
        parameter_covariance: as of ``reconstruct``.
        corrections: as of ``reconstruct``.
        device: "cpu", "cuda:0", ...; None takes the first CUDA device, or else the CPU.
        threads: most CPU threads for a large batch; None: as many as there are CPUs.

    Raises:
        InvalidParameter: too many sensors, terms of too high powers, a covariance of another
            shape, a table of other sensors, or a device that is not there.
    """

    def __init__(
        self,
        cameras: Sequence[SensorModel] | CameraStack,
        parameter_covariance: Array | None = None,
        corrections: CorrectionTable | None = None,
        device: str | None = None,
        threads: int | None = None,
    ) -> None:
        # Here and not above: Warp takes a second to load, and the types are used without it.
        import warp as wp

        stack = cameras if isinstance(cameras, CameraStack) else CameraStack.of(cameras)
        if not 1 <= len(stack) <= MAX_SENSORS:
            raise InvalidParameter(
                f"there are {len(stack)} sensors; there must be 1 to {MAX_SENSORS}"
            )
        for term in stack.terms:
            if max(term) > MAX_POWER:
                raise InvalidParameter(
                    f"a term of distortion has the powers {term}; they must be {MAX_POWER} at most"
                )
        check_calibration(stack, parameter_covariance, corrections)
        self.sensors = len(stack)
        target_device = warp_device(wp, device)
        self.device = str(target_device.alias)
        # Kept: the job has their addresses.
        self._arrays: list[Any] = []
        job = np.zeros(1, dtype=JOB)

        def keep(array: NDArray[Any]) -> int:
            values: Any = np.ascontiguousarray(array)
            if target_device.is_cuda:
                values = wp.array(values, device=target_device) if values.size else None
            self._arrays.append(values)
            if values is None:
                return 0
            return int(values.ptr) if target_device.is_cuda else address(values)

        row = row_length(self.sensors, cuda=bool(target_device.is_cuda))
        fill_cameras(job["cameras"], keep, stack, corrections, row)
        job["chi2_limits"] = keep(chi2_limits(self.sensors))
        job["noncentralities"] = keep(noncentralities(self.sensors))
        if parameter_covariance is not None:
            covariance = stack.covariance_blocks(np.asarray(parameter_covariance))
            job["parameter_covariance"] = keep(covariance)
        kernel = point_kernel(self.sensors, term_capacity(stack))
        self.launch: CpuLaunch | CudaLaunch = (
            CudaLaunch(wp, kernel, job, self.sensors, target_device)
            if target_device.is_cuda
            else CpuLaunch(wp, kernel, job, self.sensors, threads)
        )
        # Loads the kernel, before the first frame waits for it.
        self.solve(np.full((1, self.sensors), np.nan), np.ones(self.sensors))

    def solve(self, readings_px: Array, sigma_px: Array) -> PointBatch:
        """Return the points of readings.

        Args:
            readings_px: shape (N, S) [px]; NaN where a sensor did not see the point.
            sigma_px: standard deviations of the readings, shape (N, S) or (S,) [px], positive.

        Raises:
            InvalidParameter: other shapes.
        """
        readings = np.ascontiguousarray(readings_px, dtype=np.float64)
        if readings.ndim != 2 or readings.shape[1] != self.sensors:
            raise InvalidParameter(
                f"readings have the shape {readings.shape}; it must be (N, {self.sensors})",
                shape=readings.shape,
            )
        sigma = np.asarray(sigma_px, dtype=np.float64)
        if sigma.shape not in (readings.shape, (self.sensors,)):
            raise InvalidParameter(
                f"sigma_px has the shape {sigma.shape}; it must be {readings.shape} or "
                f"({self.sensors},)",
                shape=sigma.shape,
            )
        if len(readings) == 0:
            return PointBatch.empty(self.sensors)
        if sigma.ndim == 1:
            sigma = np.repeat(sigma[None], len(readings), axis=0)
        return self.launch.solve(readings, np.ascontiguousarray(sigma))


def point_kernel(sensors: int, capacity: int) -> Any:
    """Return the kernel of the triangulation; launch it with one thread a point. Loads Warp.

    Args:
        sensors: number of sensors S.
        capacity: largest number of terms of distortion.
    """
    from compute.native.native_kernel import native_kernel

    return native_kernel(
        "compute/reconstruction/native/triangulation.h",
        f"lumiline::solve_point<{sensors}, {capacity}>(number, address);",
    )


def load_kernels(sensors: int, device: str | None = None) -> None:
    """Load the kernels for a number of sensors, with up to MIN_CAPACITY terms of distortion.

    Args:
        sensors: number of sensors S.
        device: as of ``PointSolver``.

    Raises:
        InvalidParameter: no such device.
    """
    import warp as wp

    target_device = warp_device(wp, device)
    # As they are launched: a kernel is built anew for blocks of another size.
    block = 1 if target_device.is_cpu else THREADS_PER_BLOCK
    for capacity in (0, MIN_CAPACITY):
        point_kernel(sensors, capacity).module.load(target_device, block_dim=block)


def term_capacity(cameras: CameraStack) -> int:
    """Return how many terms of distortion the kernel for these cameras has room for."""
    if not cameras.has_distortion:
        return 0
    capacity = MIN_CAPACITY
    while capacity < len(cameras.terms):
        capacity *= 2
    return capacity
