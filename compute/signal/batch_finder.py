"""BatchFinder: what finders of peaks share: batches of lines to a device, records back."""

from abc import ABC, abstractmethod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from compute.signal.noise import LineNoise
from compute.signal.peaks import PeakBatch
from compute.signal.settings import MAX_PIXELS, MIN_PIXELS, CentroidSettings
from compute.warp_host import host_memory, warp_device


class BatchFinder(ABC):
    """Brings lines to a device, starts recorded launches there, brings one record a line back.

    Warp is not thread-safe: one thread makes the finder and calls it. Buffers are allocated
    once. On the CPU the lines stay where they are, and the launches get their address.

    Args:
        lines: most lines of one call.
        pixels: pixels of each line, 64 to 65536.
        record: what the kernels write for a line; its size is a multiple of 8 bytes.
        device: "cpu", "cuda:0", ...; None takes the first CUDA device, or else the CPU.

    Raises:
        InvalidParameter: a size outside its range, or a device that is not there.
    """

    def __init__(
        self, lines: int, pixels: int, record: np.dtype[np.void], device: str | None
    ) -> None:
        if lines < 1:
            raise InvalidParameter(f"lines is {lines}; it must be 1 or more", lines=lines)
        if not MIN_PIXELS <= pixels <= MAX_PIXELS:
            raise InvalidParameter(
                f"a line has {pixels} pixels; it must have {MIN_PIXELS} to {MAX_PIXELS}",
                pixels=pixels,
            )
        # Here and not above: Warp takes a second to load, and the types are used without it.
        import warp as wp

        self._wp = wp
        self.lines = lines
        self.pixels = pixels
        self._device = warp_device(wp, device)
        self.device = str(self._device.alias)
        self._cuda = bool(self._device.is_cuda)

        size = record.itemsize * lines
        # Records as 64-bit words, which also aligns them.
        self._records = wp.zeros(size // 8, dtype=wp.uint64, device=self._device)
        if self._cuda:
            self._input = wp.zeros(lines * pixels, dtype=wp.uint16, device=self._device)
            staged = wp.zeros(lines * pixels, dtype=wp.uint16, device="cpu", pinned=True)
            self._staged_input = staged
            self._host_input = host_memory(staged)
            self._staged_records = wp.zeros(size // 8, dtype=wp.uint64, device="cpu", pinned=True)
        else:
            self._staged_records = self._records
        self._uploaded = 0
        self._words_per_line = record.itemsize // 8
        self._host_records = host_memory(self._staged_records).view(record)
        self._launches: list[tuple[Any, int]] = []

    def find(self, lines: NDArray[np.uint16]) -> PeakBatch:
        """Find the peaks of lines, uint16, shape (L, P), with L at most the finder's ``lines``.

        Only the returned arrays are allocated (and a copy, where the rows do not lie one after
        another in memory).

        Raises:
            InvalidParameter: another type or shape.
        """
        self.upload(lines)
        if len(lines) == 0:
            return self._collect(self._host_records[:0])
        self.launch(len(lines))
        return self.download(len(lines))

    def upload(self, lines: NDArray[np.uint16]) -> None:
        """Bring lines to the device; on the CPU they stay where they are, until ``launch``.

        ``find`` is upload, launch and download; apart, they time the kernel alone.
        """
        self._check(lines)
        flat = np.ascontiguousarray(lines).reshape(-1)
        self._uploaded = len(lines)
        if flat.size == 0:
            return
        if self._cuda:
            self._host_input[: flat.size] = flat
            self._wp.copy(self._input, self._staged_input, count=flat.size)
        else:
            self._source = flat  # kept alive: the kernels have only its address
            for launch, _ in self._launches:
                launch.set_param_at_index(0, flat.ctypes.data)

    def launch(self, count: int) -> None:
        """Start the kernels on the first ``count`` of the uploaded lines.

        Raises:
            InvalidParameter: there are not so many.
        """
        if not 1 <= count <= self._uploaded:
            raise InvalidParameter(
                f"count is {count}; it must be 1 .. {self._uploaded}, the lines uploaded",
                count=count,
            )
        for launch, lanes in self._launches:
            launch.set_dim(count * lanes)
            launch.launch()

    def download(self, count: int) -> PeakBatch:
        """Wait for the kernels and return the peaks of the first ``count`` lines."""
        if self._cuda:
            self._wp.copy(self._staged_records, self._records, count=count * self._words_per_line)
            self._wp.synchronize_stream(self._device)
        return self._collect(self._host_records[:count])

    @abstractmethod
    def _collect(self, records: NDArray[np.void]) -> PeakBatch:
        """Return lines' records as a batch, in arrays of its own."""

    def _record_launch(
        self, kernel: Any, lanes: int, inputs: list[Any], block_dim: int = 64
    ) -> None:
        """Add a kernel, with so many threads a line; the lines' address comes before ``inputs``."""
        launch = self._wp.launch(
            kernel,
            dim=self.lines * lanes,
            inputs=[self._input.ptr if self._cuda else 0, *inputs],
            device=self._device,
            block_dim=block_dim,
            record_cmd=True,
        )
        self._launches.append((launch, lanes))

    def _noise_arrays(self, noise: LineNoise) -> list[Any]:
        """Return the sensors' noise as the kernels take it; keep it, they have its addresses."""
        return [
            self._wp.array(values, dtype=dtype, device=self._device)
            for values, dtype in (
                (noise.dark_variance, self._wp.float64),
                (noise.photon_variance, self._wp.float64),
                (noise.offset_counts, self._wp.float64),
                (noise.full_scale_counts, self._wp.int32),
            )
        ]

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


def search_arguments(settings: CentroidSettings) -> list[Any]:
    """Return the settings as the kernels of the search take them, in their order."""
    return [
        settings.detection_sigma,
        settings.fraction_units,
        int(settings.weighting != "above-background"),
        int(settings.weighting == "edge-corrected"),
        settings.min_width_px,
        settings.max_peaks,
    ]
