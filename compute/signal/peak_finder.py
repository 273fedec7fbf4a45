"""PeakFinder: launches a kernel over batches of scans, in buffers of its own, on one device."""

import gc
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from compute.signal.centroid_settings import MAX_PIXELS, MIN_PIXELS, CentroidSettings
from compute.signal.native.definitions import BLOCK_THREADS
from compute.signal.peaks import MAX_JOINT_PEAKS, PeakBatch
from compute.signal.pixel_corrections import PixelCorrections
from compute.signal.sensor_noise import SensorNoise
from compute.warp_host import (
    PackedLaunch,
    address,
    check_threads,
    host_memory,
    warp_device,
    worker_threads,
)

if TYPE_CHECKING:
    from compute.signal.native.scan_kernel import Search

WARP_LANES: Final = 32
FILLING_WARPS: Final = 2048
"""Number of warps that fill a large GPU; with more scans each warp takes several."""
HEAD_START_PIXELS: Final = 262_144
"""Pixels that the calling thread takes more than the others, which take time to wake."""
MAX_GRAPHS: Final = 64
"""Sizes of batches for which a CUDA graph is kept."""
GRAPH_PIXELS: Final = 1 << 20
"""Largest batch that is launched by a CUDA graph; a larger one gains nothing measurable."""
DIRECT_PIXELS: Final = 1 << 16
"""Largest batch that stays in the host's memory, which the device reads and writes directly:
starting a copy takes longer."""
MAX_VALUES: Final = 2**31 - 1
"""Values of one of Warp's arrays."""

# Parameters of the kernel.
_SCANS, _COUNT, _PER_WARP, _RECORDS = range(4)


class PeakFinder:
    """Finds the peaks of scans by a compiled kernel; CentroidFinder and FitFinder are of this kind.

    Warp is not thread-safe: one thread makes the finder and calls it. On the CPU other threads
    run parts of a large batch, but all they call is the compiled kernel. Making it loads Warp and
    compiles the kernel, unless an earlier process has (seconds); ``find`` does neither.

    Args:
        search: the kernel.
        max_scans: largest number of scans of one call.
        pixels: pixels of each scan, 64 to 65536.
        settings: of the search.
        noise: noise of the S sensors; scan l of a batch is of sensor ``l % S``, so that frames
            of shape (S, P) may be put one after another.
        record: type of a scan's record; its size is a multiple of 8 bytes.
        device: "cpu", "cuda:0", ...; None takes the first CUDA device, or else the CPU.
        threads: largest number of CPU threads for a batch; None: as many as there are CPUs.
        scans_per_warp: scans that a warp takes, where there are enough for all warps.
        pixels_per_thread: smallest share of pixels for which another CPU thread pays.
        plan: 64-bit words that the fit reads; None: no fit follows.
        corrections: of the S sensors' pixels; None: counts are taken as they are.
        reads_once: the kernel reads scans only once and no records; those of small batches then
            are not copied.

    Raises:
        InvalidParameter: a size outside its range, or a device that is not there.
    """

    def __init__(
        self,
        search: "Search",
        max_scans: int,
        pixels: int,
        settings: CentroidSettings,
        noise: SensorNoise,
        record: np.dtype[np.void],
        device: str | None,
        threads: int | None,
        *,
        scans_per_warp: int,
        pixels_per_thread: int,
        plan: NDArray[np.uint64] | None = None,
        corrections: PixelCorrections | None = None,
        reads_once: bool = False,
    ) -> None:
        # Here and not above: Warp takes a second to load, and the types are used without it.
        import warp as wp

        from compute.signal.native.scan_kernel import ScanBatch, scan_kernel

        if max_scans < 1:
            raise InvalidParameter(f"scans is {max_scans}; it must be 1 or more", scans=max_scans)
        if not MIN_PIXELS <= pixels <= MAX_PIXELS:
            raise InvalidParameter(
                f"a scan has {pixels} pixels; it must have {MIN_PIXELS} to {MAX_PIXELS}",
                pixels=pixels,
            )
        if corrections is not None and corrections.dark.shape != (len(noise), pixels):
            raise InvalidParameter(
                f"corrections are of {len(corrections)} sensors with {corrections.dark.shape[1]} "
                f"pixels; they must be of {len(noise)} with {pixels}"
            )
        self._threads = check_threads(threads)
        self._wp = wp
        self.max_scans = max_scans
        self.pixels = pixels
        self._sensors = len(noise)
        self._device = warp_device(wp, device)
        self.device = str(self._device.alias)
        """Name of the device."""
        self.cuda = bool(self._device.is_cuda)
        self._record_bytes = record.itemsize
        self._reads_once = reads_once
        self._scans_per_warp = scans_per_warp
        self._pixels_per_thread = pixels_per_thread

        check_capacity(max_scans, pixels, record.itemsize // 8, copied=self.cuda)
        words = record.itemsize // 8 * max_scans
        # Records as 64-bit words, which also aligns them.
        self._records = wp.zeros(words, dtype=wp.uint64, device=self._device)
        if self.cuda:
            size = max_scans * pixels
            self._input = wp.zeros(size, dtype=wp.uint16, device=self._device)
            self._staged_input = wp.zeros(size, dtype=wp.uint16, device="cpu", pinned=True)
            self._host_input = host_memory(self._staged_input)
            self._staged_records = wp.zeros(words, dtype=wp.uint64, device="cpu", pinned=True)
        else:
            self._staged_records = self._records
        self._host_words = host_memory(self._staged_records)
        self._record = record
        self._columns = record["peaks"].base.names or ()
        # Read-only columns of all batches of centres of gravity, whose records lack them.
        shape = (max_scans, settings.max_peaks)
        fitted = {
            "reduced_chi2": np.full(shape, np.nan, np.float32),
            "covariance_px2": np.zeros((*shape, MAX_JOINT_PEAKS - 1), np.float32),
        }
        self._absent = {name: fitted[name] for name in fitted if name not in self._columns}
        for array in self._absent.values():
            array.flags.writeable = False

        # Batch and plan are kept: the launches have the addresses of their arrays.
        self._batch = batch = ScanBatch()
        batch.lanes = WARP_LANES if self.cuda else 1
        batch.pixels, batch.sensors = pixels, len(noise)
        batch.record_bytes = record.itemsize
        for name in ("dark_variance", "photon_variance", "offset_counts", "full_scale_counts"):
            setattr(batch, name, wp.array(getattr(noise, name), device=self._device))
        batch.detection_sigma = wp.float64(settings.detection_sigma)
        batch.fraction_units = settings.fraction_units
        batch.weigh_above_threshold = int(settings.weighting != "above-background")
        batch.correct_edges = int(settings.weighting == "edge-corrected")
        batch.min_width_px, batch.max_peaks = settings.min_width_px, settings.max_peaks
        if corrections is not None:
            packed = corrections.pack()
            self._corrections: Any = wp.array(packed, dtype=wp.uint64, device=self._device)
            batch.corrections_address = self._corrections.ptr
        if plan is not None:
            self._plan: Any = wp.array(plan, dtype=wp.uint64, device=self._device)
            batch.plan_address = self._plan.ptr
            batch.candidates_offset = record.fields["candidates"][1] if record.fields else 0
        self._uploaded = 0
        self._source = np.empty(0, np.uint16)
        self._graphs: dict[int, Any] = {}
        self._prepared: list[tuple[int, int] | None] = [None] * self._threads
        scans = self._input.ptr if self.cuda else 0
        launches = [
            wp.launch(
                scan_kernel(search, corrections is not None),
                dim=1,
                inputs=[scans, max_scans, 1, self._records.ptr, batch],
                device=self._device,
                block_dim=BLOCK_THREADS if self.cuda else 1,
                record_cmd=True,
            )
            for _ in range(1 if self.cuda else self._threads)
        ]
        self._cuda_launch: Any = launches[0]
        self._cpu_launches = [] if self.cuda else [PackedLaunch(launch) for launch in launches]

    def find(self, scans: NDArray[np.uint16]) -> PeakBatch:
        """Find the peaks of scans, uint16, shape (L, P), L at most the finder's ``max_scans``.

        Only the returned arrays are allocated (and a copy, where the rows do not lie one after
        another in memory).

        Raises:
            InvalidParameter: another type or shape.
        """
        self._check(scans)
        count = len(scans)
        if not self.cuda or count == 0 or count * self.pixels > GRAPH_PIXELS:
            self.upload(scans)
            if count:
                self.launch(count)
            return self.download(count)
        self._host_input[: scans.size] = np.ascontiguousarray(scans).reshape(-1)
        self._uploaded = count
        self._wp.capture_launch(self._graph(count))
        self._wp.synchronize_stream(self._device)
        return self._peaks(count)

    def upload(self, scans: NDArray[np.uint16]) -> None:
        """Copy scans to the device; on the CPU they stay where they are, until ``launch``.

        ``find`` is upload, launch and download; apart, they time the kernel alone.

        Raises:
            InvalidParameter: another type or shape.
        """
        self._check(scans)
        flat = np.ascontiguousarray(scans).reshape(-1)
        self._uploaded = len(scans)
        if flat.size == 0:
            return
        if self.cuda:
            self._host_input[: flat.size] = flat
            self._wp.copy(self._input, self._staged_input, count=flat.size)
        else:
            self._source = flat  # kept alive: the kernel has only its address

    def launch(self, count: int) -> None:
        """Start the kernel on the first ``count`` of the uploaded scans; the CPU also ends it.

        Raises:
            InvalidParameter: there are fewer.
        """
        if not 1 <= count <= self._uploaded:
            raise InvalidParameter(
                f"count is {count}; it must be 1 .. {self._uploaded}, the scans uploaded",
                count=count,
            )
        if self.cuda:
            self._launch_cuda(count)
            return
        starts = self._parts(count)
        source = address(self._source)
        launches = self._cpu_launches[: len(starts) - 1]
        for part, (first, end) in enumerate(pairwise(starts)):
            launch = launches[part]
            launch.arguments.scans_address = source + first * self.pixels * 2
            # It takes as long as some scans.
            if self._prepared[part] != (first, end):
                self._prepared[part] = (first, end)
                launch.arguments.scans = end - first
                launch.arguments.records_address = self._records.ptr + first * self._record_bytes
                launch.set_dim(end - first)
        pending = [worker_threads().submit(launch.run) for launch in launches[1:]]
        launches[0].run()
        for future in pending:
            future.result()

    def download(self, count: int) -> PeakBatch:
        """Wait for the kernel and return the peaks of the first ``count`` scans."""
        if self.cuda:
            self._copy_back(count)
            self._wp.synchronize_stream(self._device)
        return self._peaks(count)

    def _peaks(self, count: int) -> PeakBatch:
        """Return the peaks of the newest records, which stand only until the next call."""
        # As words: NumPy copies structures, and columns of them, more slowly.
        words = self._host_words[: count * self._record_bytes // 8].copy()
        records = words.view(self._record)
        peaks = records["peaks"]
        columns = {name: peaks[name] for name in self._columns}
        absent: dict[str, Any] = {name: values[:count] for name, values in self._absent.items()}
        return PeakBatch(count=records["count"], **absent, **columns)

    def _parts(self, count: int) -> list[int]:
        """Return where the parts of a batch begin, and its end; each begins with sensor 0.

        The first is the caller's own.
        """
        shared = count * self.pixels - HEAD_START_PIXELS
        threads = min(self._threads, shared // self._pixels_per_thread)
        if threads <= 1:
            return [0, count]
        frames = -(-count // self._sensors)
        ahead = min(HEAD_START_PIXELS // (self.pixels * self._sensors), frames)
        starts = [(ahead + part * (frames - ahead) // threads) for part in range(1, threads)]
        return [0, *dict.fromkeys(start * self._sensors for start in starts if start > 0), count]

    def _launch_cuda(self, count: int) -> None:
        launch = self._cuda_launch
        per_warp = max(min(self._scans_per_warp, count // FILLING_WARPS), 1)
        launch.set_param_at_index(_COUNT, count)
        launch.set_param_at_index(_PER_WARP, per_warp)
        launch.set_dim(-(-count // per_warp) * WARP_LANES)
        launch.launch()

    def _copy_back(self, count: int) -> None:
        words = count * self._record_bytes // 8
        self._wp.copy(self._staged_records, self._records, count=words)

    def _graph(self, count: int) -> Any:
        """Return the graph for this number of scans: kernel, with the copies that it needs."""
        graph = self._graphs.pop(count, None) or self._capture(count)
        self._graphs[count] = graph  # the newest last
        if len(self._graphs) > MAX_GRAPHS:
            del self._graphs[next(iter(self._graphs))]
        return graph

    def _capture(self, count: int) -> Any:
        direct = self._reads_once and count * self.pixels <= DIRECT_PIXELS
        launch = self._cuda_launch
        if direct:
            launch.set_param_at_index(_SCANS, self._staged_input.ptr)
            launch.set_param_at_index(_RECORDS, self._staged_records.ptr)
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
            launch.set_param_at_index(_SCANS, self._input.ptr)
            launch.set_param_at_index(_RECORDS, self._records.ptr)
        return capture.graph

    def _check(self, scans: NDArray[np.uint16]) -> None:
        if scans.dtype != np.uint16:
            raise InvalidParameter(
                f"scans have the type {scans.dtype}; it must be uint16", type=str(scans.dtype)
            )
        if scans.ndim != 2 or scans.shape[1] != self.pixels or len(scans) > self.max_scans:
            raise InvalidParameter(
                f"scans have the shape {scans.shape}; it must be (L, {self.pixels}) "
                f"with L at most {self.max_scans}",
                shape=scans.shape,
            )


def check_capacity(max_scans: int, pixels: int, record_words: int, *, copied: bool) -> None:
    """Refuse batches whose records, or pixels where these are copied, no array has room for.

    Args:
        max_scans: largest number of scans of one call.
        pixels: of each.
        record_words: 64-bit words of a scan's record.
        copied: the scans are brought to the device.

    Raises:
        InvalidParameter: there are more.
    """
    capacity = MAX_VALUES // max(record_words, pixels if copied else 0)
    if max_scans > capacity:
        raise InvalidParameter(
            f"scans is {max_scans}, of {pixels} pixels each; this device takes {capacity} "
            "such scans at once: find their peaks in several batches",
            scans=max_scans,
        )
