"""Peak finder by threshold and centre of gravity, compiled by Warp for one device."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.signal.centroid_settings import CentroidSettings
from compute.signal.peak_finder import PeakFinder
from compute.signal.peaks import MAX_JOINT_PEAKS, PeakBatch
from compute.signal.sensor_noise import SensorNoise
from compute.warp_host import warp_device

PIXELS_PER_THREAD: Final = 2_097_152
"""A further CPU thread pays from twice as many pixels on: a line takes 0.3 us, waking it tens."""


class CentroidFinder(PeakFinder):
    """Threshold and centre of gravity of many scans at once (thesis [4.1], 4.2.2) by Warp.

    Warp is not thread-safe: one thread makes the finder and calls it. Making it loads Warp and
    compiles the kernel, unless an earlier process has (seconds); ``find`` does neither.

    Args:
        lines: most lines of one call.
        pixels: pixels of each line, 64 to 65536.
        settings: what counts as a peak; CentroidSettings has the definition.
        noise: noise of the S sensors; line l of a batch is of sensor ``l % S``, so that frames
            of shape (S, P) may be put one after another.
        device: "cpu", "cuda:0", ...; None takes the first CUDA device, or else the CPU.
        threads: most CPU threads for a large batch; None: as many as there are CPUs.

    Raises:
        InvalidParameter: a size outside its range, or a device that is not there.
    """

    def __init__(
        self,
        lines: int,
        pixels: int,
        settings: CentroidSettings,
        noise: SensorNoise,
        device: str | None = None,
        threads: int | None = None,
    ) -> None:
        # Here and not above: Warp takes a second to load, and the types are used without it.
        import warp as wp

        from compute.signal.native.centroid_kernel import centroid_kernel
        from compute.signal.native.centroid_source import length_of
        from compute.signal.native.cuda_launch_sizes import (
            BLOCK_PIXELS,
            LINES_PER_BATCH,
            LONG_LINES_PER_WARP,
            SHORT_PIXELS,
        )
        from compute.signal.native.kernel_runner import ScanKernelRunner
        from compute.signal.native.peak_record import line_record

        self.settings = settings
        short = pixels <= SHORT_PIXELS
        per_warp = LINES_PER_BATCH // -(-pixels // BLOCK_PIXELS) if short else LONG_LINES_PER_WARP
        on_cuda = warp_device(wp, device).is_cuda
        runner = ScanKernelRunner(
            wp,
            centroid_kernel(length_of(pixels) if on_cuda else "block"),
            lines,
            pixels,
            noise,
            [
                settings.detection_sigma,
                settings.fraction_units,
                int(settings.weighting != "above-background"),
                int(settings.weighting == "edge-corrected"),
                settings.min_width_px,
                settings.max_peaks,
            ],
            line_record(settings.max_peaks),
            device,
            threads,
            reads_once=short,
            pixels_per_thread=PIXELS_PER_THREAD,
            lines_per_warp=per_warp,
        )
        super().__init__(runner)
        shape = (lines, settings.max_peaks)
        # Of all batches: a centre of gravity has neither.
        self._reduced_chi2 = np.full(shape, np.nan, np.float32)
        self._covariance_px2 = np.zeros((*shape, MAX_JOINT_PEAKS - 1), np.float32)
        for array in (self._reduced_chi2, self._covariance_px2):
            array.flags.writeable = False

    def _collect(self, records: NDArray[np.void]) -> PeakBatch:
        own = records.copy()
        peaks, count = own["peaks"], len(own)
        return PeakBatch(
            own["count"],
            peaks["position_px"],
            peaks["sigma_px"],
            peaks["amplitude"],
            peaks["width_px"],
            peaks["flags"],
            self._reduced_chi2[:count],
            self._covariance_px2[:count],
        )
