"""Launches of a kernel over scans, with its buffers, on one device."""

import gc
from collections import OrderedDict
from collections.abc import Sequence
from itertools import pairwise
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from compute.signal.native.batch_limits import check_room, check_size
from compute.signal.native.cuda_launch_sizes import BLOCK_THREADS
from compute.signal.sensor_noise import SensorNoise
from compute.warp_host import check_threads, host_memory, warp_device, worker_threads

WARP_LANES: Final = 32
FILLING_WARPS: Final = 2048
"""Number of warps that fill a large GPU; with more scans each warp takes several."""
HEAD_START_PIXELS: Final = 262_144
"""Pixels that the calling thread takes more than the others, which take time to wake."""
PIXELS_PER_THREAD: Final = 786_432
"""Smallest share of pixels for which another thread pays, unless a kernel says otherwise."""
MAX_GRAPHS: Final = 64
"""Sizes of batches for which a CUDA graph is kept."""
GRAPH_PIXELS: Final = 1 << 20
"""Largest batch that is launched by a CUDA graph; a larger one gains nothing measurable."""
DIRECT_PIXELS: Final = 1 << 16
"""Largest batch that stays in the host's memory, which the device reads and writes directly:
starting a copy takes longer."""


class ScanKernelRunner:
    """Runs a kernel of ``compute.signal.native`` over batches of lines, in buffers of its own.

    Warp is not thread-safe: one thread makes the runner and calls it. On the CPU other threads
    run parts of a large batch, but all they call is the compiled kernel.

    Args:
        wp: the module Warp.
        kernel: takes lanes, the lines' address, their number, pixels, lines per warp, addresses
            of the noise, number of sensors, ``parameters``, the records' address and size.
        lines: most lines of one call.
        pixels: pixels of each line, 64 to 65536.
        noise: noise of the S sensors; line l of a batch is of sensor ``l % S``.
        parameters: the kernel's own.
        record: type of a line's record; its size is a multiple of 8 bytes.
        device: "cpu", "cuda:0", ...; None takes the first CUDA device, or else the CPU.
        threads: most CPU threads; None: as many as there are CPUs.
        reads_once: the kernel reads lines only once and no records; those of small batches then
            are not copied.
        lines_per_warp: most lines that a warp takes, where there are enough for all warps.
        pixels_per_thread: smallest share for which another CPU thread pays.

    Raises:
        InvalidParameter: a size outside its range, or a device that is not there.
    """

    def __init__(
        self,
        wp: Any,
        kernel: Any,
        lines: int,
        pixels: int,
        noise: SensorNoise,
        parameters: Sequence[Any],
        record: np.dtype[np.void],
        device: str | None = None,
        threads: int | None = None,
        reads_once: bool = False,
        lines_per_warp: int = 1,
        pixels_per_thread: int = PIXELS_PER_THREAD,
    ) -> None:
        check_size(lines, pixels)
        self._threads = check_threads(threads)
        self._wp = wp
        self.lines = lines
        self.pixels = pixels
        self._sensors = len(noise)
        self._device = warp_device(wp, device)
        self.device = str(self._device.alias)
        self.cuda = bool(self._device.is_cuda)
        self._record_bytes = record.itemsize
        self._reads_once = reads_once
        self._lines_per_warp = lines_per_warp
        self._pixels_per_thread = pixels_per_thread

        check_room(lines, pixels, record.itemsize // 8, copied=self.cuda)
        words = record.itemsize // 8 * lines
        # Records as 64-bit words, which also aligns them.
        self._records = wp.zeros(words, dtype=wp.uint64, device=self._device)
        if self.cuda:
            self._input = wp.zeros(lines * pixels, dtype=wp.uint16, device=self._device)
            self._staged_input = wp.zeros(
                lines * pixels, dtype=wp.uint16, device="cpu", pinned=True
            )
            self._host_input = host_memory(self._staged_input)
            self._staged_records = wp.zeros(words, dtype=wp.uint64, device="cpu", pinned=True)
        else:
            self._staged_records = self._records
        self._host_records = host_memory(self._staged_records).view(record)
        # Kept: the launches have their addresses.
        self._noise = [
            wp.array(values, dtype=dtype, device=self._device)
            for values, dtype in (
                (noise.dark_variance, wp.float64),
                (noise.photon_variance, wp.float64),
                (noise.offset_counts, wp.float64),
                (noise.full_scale_counts, wp.int32),
            )
        ]
        self._uploaded = 0
        self._source = np.empty(0, np.uint16)
        self._graphs: OrderedDict[int, Any] = OrderedDict()
        arguments = [
            WARP_LANES if self.cuda else 1,
            self._input.ptr if self.cuda else 0,
            lines,
            pixels,
            1,
            *(array.ptr for array in self._noise),
            len(noise),
            *parameters,
            self._records.ptr,
            record.itemsize,
        ]
        self._records_index = len(arguments) - 2
        self._prepared: list[tuple[int, int] | None] = [None] * self._threads
        self._launches = [
            wp.launch(
                kernel,
                dim=1,
                inputs=arguments,
                device=self._device,
                block_dim=BLOCK_THREADS if self.cuda else 1,
                record_cmd=True,
            )
            for _ in range(1 if self.cuda else self._threads)
        ]

    def find(self, lines: NDArray[np.uint16]) -> NDArray[np.void]:
        """Run the kernel over lines, uint16, shape (L, P); return their records, shape (L,).

        The records stand until the next call.

        Raises:
            InvalidParameter: another type or shape.
        """
        self._check(lines)
        count = len(lines)
        if count == 0:
            return self._host_records[:0]
        if not self.cuda or count * self.pixels > GRAPH_PIXELS:
            self.upload(lines)
            self.launch(count)
            return self.download(count)
        self._host_input[: lines.size] = np.ascontiguousarray(lines).reshape(-1)
        self._uploaded = count
        self._wp.capture_launch(self._graph(count))
        self._wp.synchronize_stream(self._device)
        return self._host_records[:count]

    def upload(self, lines: NDArray[np.uint16]) -> None:
        """Bring lines to the device; on the CPU they stay where they are, until ``launch``.

        Raises:
            InvalidParameter: another type or shape.
        """
        self._check(lines)
        flat = np.ascontiguousarray(lines).reshape(-1)
        self._uploaded = len(lines)
        if flat.size == 0:
            return
        if self.cuda:
            self._host_input[: flat.size] = flat
            self._wp.copy(self._input, self._staged_input, count=flat.size)
        else:
            self._source = flat  # kept alive: the kernel has only its address

    def launch(self, count: int) -> None:
        """Start the kernel on the first ``count`` of the uploaded lines; the CPU also ends it.

        Raises:
            InvalidParameter: there are fewer.
        """
        if not 1 <= count <= self._uploaded:
            raise InvalidParameter(
                f"count is {count}; it must be 1 .. {self._uploaded}, the lines uploaded",
                count=count,
            )
        if self.cuda:
            self._launch_cuda(count)
            return
        starts = self._parts(count)
        launches = self._launches[: len(starts) - 1]
        for part, (first, end) in enumerate(pairwise(starts)):
            launch = launches[part]
            launch.set_param_at_index(1, self._source.ctypes.data + first * self.pixels * 2)
            # Setting a parameter takes a microsecond: as long as a line.
            if self._prepared[part] != (first, end):
                self._prepared[part] = (first, end)
                launch.set_param_at_index(2, end - first)
                launch.set_param_at_index(
                    self._records_index, self._records.ptr + first * self._record_bytes
                )
                launch.set_dim(end - first)
        pending = [worker_threads().submit(launch.launch) for launch in launches[1:]]
        launches[0].launch()
        for future in pending:
            future.result()

    def download(self, count: int) -> NDArray[np.void]:
        """Wait for the kernel and return the records of the first ``count`` lines."""
        if self.cuda:
            self._copy_back(count)
            self._wp.synchronize_stream(self._device)
        return self._host_records[:count]

    def _parts(self, count: int) -> list[int]:
        """Return where the parts of a batch begin, and its end; each begins with sensor 0.

        The first is the caller's own.
        """
        shared = count * self.pixels - HEAD_START_PIXELS
        threads = min(self._threads, max(shared // self._pixels_per_thread, 1))
        if threads == 1:
            return [0, count]
        frames = -(-count // self._sensors)
        ahead = min(HEAD_START_PIXELS // (self.pixels * self._sensors), frames)
        starts = [(ahead + part * (frames - ahead) // threads) for part in range(1, threads)]
        return [0, *dict.fromkeys(start * self._sensors for start in starts if start > 0), count]

    def _launch_cuda(self, count: int) -> None:
        launch = self._launches[0]
        per_warp = max(min(self._lines_per_warp, count // FILLING_WARPS), 1)
        launch.set_param_at_index(2, count)
        launch.set_param_at_index(4, per_warp)
        launch.set_dim(-(-count // per_warp) * WARP_LANES)
        launch.launch()

    def _copy_back(self, count: int) -> None:
        words = count * self._record_bytes // 8
        self._wp.copy(self._staged_records, self._records, count=words)

    def _graph(self, count: int) -> Any:
        """Return the graph for this number of lines: kernel, with the copies that it needs."""
        graph = self._graphs.get(count)
        if graph is not None:
            self._graphs.move_to_end(count)
            return graph
        direct = self._reads_once and count * self.pixels <= DIRECT_PIXELS
        launch = self._launches[0]
        if direct:
            launch.set_param_at_index(1, self._staged_input.ptr)
            launch.set_param_at_index(self._records_index, self._staged_records.ptr)
        # Loads the module, which a capture must not.
        self._launch_cuda(count)
        self._wp.synchronize_stream(self._device)
        # Memory that another thread's garbage collection frees would end the capture.
        collects = gc.isenabled()
        gc.disable()
        try:
            with self._wp.ScopedCapture(self._device) as capture:
                if not direct:
                    self._wp.copy(self._input, self._staged_input, count=count * self.pixels)
                self._launch_cuda(count)
                if not direct:
                    self._copy_back(count)
        finally:
            if collects:
                gc.enable()
            launch.set_param_at_index(1, self._input.ptr)
            launch.set_param_at_index(self._records_index, self._records.ptr)
        self._graphs[count] = capture.graph
        if len(self._graphs) > MAX_GRAPHS:
            self._graphs.popitem(last=False)
        return capture.graph

    def _check(self, lines: NDArray[np.uint16]) -> None:
        if lines.dtype != np.uint16:
            raise InvalidParameter(
                f"lines have the type {lines.dtype}; it must be uint16", type=str(lines.dtype)
            )
        if lines.ndim != 2 or lines.shape[1] != self.pixels or len(lines) > self.lines:
            raise InvalidParameter(
                f"lines have the shape {lines.shape}; it must be (L, {self.pixels}) "
                f"with L at most {self.lines}",
                shape=lines.shape,
            )
