"""Peak finder by weighted fit, compiled by Warp for one device."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from compute.signal.fit.fit_settings import FitSettings
from compute.signal.fit.fitted_record import fitted_line_record
from compute.signal.fit.kernel_parameters import pack_plan
from compute.signal.fit.line_spread_function import LineSpreadFunction
from compute.signal.peak_finder import PeakFinder
from compute.signal.peaks import PeakBatch
from compute.signal.sensor_noise import SensorNoise
from compute.warp_host import warp_device


class FitFinder(PeakFinder):
    """Search and weighted fit of many scans at once by Warp; ``FitSettings`` defines it.

    Warp is not thread-safe: one thread makes the finder and calls it. Making it loads Warp and
    compiles the kernel, unless an earlier process has (seconds); ``find`` does neither.

    Args:
        lines: most lines of one call.
        pixels: pixels of each line, 64 to 65536.
        settings: how lines are fitted.
        noise: noise of the S sensors; line l of a batch is of sensor ``l % S``, so that frames
            of shape (S, P) may be put one after another.
        shape: how a line's light is spread; None: a Gaussian.
        device: "cpu", "cuda:0", ...; None takes the first CUDA device, or else the CPU.
        threads: most CPU threads for a large batch; None: as many as there are CPUs.

    Raises:
        InvalidParameter: a size outside its range, or a device that is not there.
    """

    def __init__(
        self,
        lines: int,
        pixels: int,
        settings: FitSettings,
        noise: SensorNoise,
        shape: LineSpreadFunction | None = None,
        device: str | None = None,
        threads: int | None = None,
    ) -> None:
        # Here and not above: Warp takes a second to load, and the types are used without it.
        import warp as wp

        from compute.signal.fit.fit_kernel import fit_peaks
        from compute.signal.native.cuda_launch_sizes import FIT_LINES_PER_WARP
        from compute.signal.native.kernel_runner import ScanKernelRunner

        search = settings.search
        record = fitted_line_record(search.max_peaks)
        self.settings = settings
        # Kept: the launches have its address.
        self._plan: Any = wp.array(
            pack_plan(settings, LineSpreadFunction.gaussian() if shape is None else shape),
            dtype=wp.uint64,
            device=warp_device(wp, device),
        )
        runner = ScanKernelRunner(
            wp,
            fit_peaks,
            lines,
            pixels,
            noise,
            [
                search.detection_sigma,
                search.fraction_units,
                int(search.weighting != "above-background"),
                int(search.weighting == "edge-corrected"),
                search.min_width_px,
                search.max_peaks,
                self._plan.ptr,
                record.fields["candidates"][1] if record.fields else 0,
            ],
            record,
            device,
            threads,
            lines_per_warp=FIT_LINES_PER_WARP,
        )
        super().__init__(runner)

    def _collect(self, records: NDArray[np.void]) -> PeakBatch:
        peaks = records["peaks"]
        return PeakBatch(
            records["count"].copy(),
            peaks["position_px"].copy(),
            peaks["sigma_px"].copy(),
            peaks["amplitude"].copy(),
            peaks["width_px"].copy(),
            peaks["flags"].copy(),
            peaks["reduced_chi2"].copy(),
            peaks["covariance_px2"].copy(),
        )
