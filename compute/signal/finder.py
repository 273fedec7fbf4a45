"""CentroidFinder: finds the peaks of batches of lines on one device, in buffers of its own."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from compute.signal.noise import LineNoise
from compute.signal.peaks import JOINT_PEAKS, PeakBatch
from compute.signal.settings import MAX_PIXELS, MIN_PIXELS, CentroidSettings
from compute.warp_host import host_memory, warp_device


class CentroidFinder:
    """Threshold and centre of gravity of many lines at once (thesis [4.1], 4.2.2) by Warp.

    Warp is not thread-safe: one thread makes the finder and calls it. Making it loads Warp and
    compiles the kernel, unless an earlier process has (seconds); ``find`` does neither.

    Args:
        lines: most lines of one call.
        pixels: pixels of each line, 64 to 65536.
        settings: what counts as a peak; CentroidSettings has the definition.
        noise: noise of the S sensors; line l of a batch is of sensor ``l % S``, so that frames
            of shape (S, P) may be put one after another.
        device: "cpu", "cuda:0", ...; None takes the first CUDA device, or else the CPU.

    Raises:
        InvalidParameter: a size outside its range, or a device that is not there.
    """

    def __init__(
        self,
        lines: int,
        pixels: int,
        settings: CentroidSettings,
        noise: LineNoise,
        device: str | None = None,
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

        from compute.signal.centroid_kernel import CUDA_LANES, find_peaks, line_record

        self._wp = wp
        self.lines = lines
        self.pixels = pixels
        self.settings = settings
        self._device = warp_device(wp, device)
        self.device = str(self._device.alias)
        self._cuda = bool(self._device.is_cuda)
        self._lanes = CUDA_LANES if self._cuda else 1

        record = line_record(settings.max_peaks)
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

        # Kept: the recorded launch has their addresses.
        self._noise: list[Any] = [
            wp.array(values, dtype=dtype, device=self._device)
            for values, dtype in (
                (noise.dark_variance, wp.float64),
                (noise.photon_variance, wp.float64),
                (noise.offset_counts, wp.float64),
                (noise.full_scale_counts, wp.int32),
            )
        ]
        self._launch = wp.launch(
            find_peaks,
            dim=lines * self._lanes,
            inputs=[
                self._input.ptr if self._cuda else 0,
                pixels,
                self._lanes,
                *self._noise,
                settings.detection_sigma,
                settings.fraction_units,
                int(settings.weighting != "above-background"),
                int(settings.weighting == "edge-corrected"),
                settings.min_width_px,
                settings.max_peaks,
                self._records.ptr,
                record.itemsize,
            ],
            device=self._device,
            block_dim=64,
            record_cmd=True,
        )

    def find(self, lines: NDArray[np.uint16]) -> PeakBatch:
        """Find the peaks of lines, uint16, shape (L, P), with L at most the finder's ``lines``.

        Only the returned arrays are allocated (and a copy, where the rows do not lie one after
        another in memory).

        Raises:
            InvalidParameter: another type or shape.
        """
        self.upload(lines)
        if len(lines) == 0:
            return self._collect(0)
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
            self._source = flat  # kept alive: the kernel has only its address
            self._launch.set_param_at_index(0, flat.ctypes.data)

    def launch(self, count: int) -> None:
        """Start the kernel on the first ``count`` of the uploaded lines.

        Raises:
            InvalidParameter: there are not so many.
        """
        if not 1 <= count <= self._uploaded:
            raise InvalidParameter(
                f"count is {count}; it must be 1 .. {self._uploaded}, the lines uploaded",
                count=count,
            )
        self._launch.set_dim(count * self._lanes)
        self._launch.launch()

    def download(self, count: int) -> PeakBatch:
        """Wait for the kernel and return the peaks of the first ``count`` lines."""
        if self._cuda:
            self._wp.copy(self._staged_records, self._records, count=count * self._words_per_line)
            self._wp.synchronize_stream(self._device)
        return self._collect(count)

    def _collect(self, count: int) -> PeakBatch:
        records = self._host_records[:count]
        peaks = records["peaks"]
        shape = (count, self.settings.max_peaks)
        return PeakBatch(
            records["count"].copy(),
            peaks["position_px"].copy(),
            peaks["sigma_px"].copy(),
            peaks["amplitude"].copy(),
            peaks["width_px"].copy(),
            peaks["flags"].copy(),
            np.full(shape, np.nan, np.float32),
            np.zeros((*shape, JOINT_PEAKS - 1), np.float32),
        )

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
