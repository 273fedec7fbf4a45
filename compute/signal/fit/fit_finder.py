"""FitFinder: fits the peaks of batches of lines on one device, in buffers of its own."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from compute.signal.fit.fit_plan import pack_plan
from compute.signal.fit.settings import FitSettings
from compute.signal.fit.shape import LineShape
from compute.signal.noise import LineNoise
from compute.signal.peaks import PeakBatch
from compute.warp_host import warp_device


class FitFinder:
    """Search and weighted fit of many lines at once by Warp; ``FitSettings`` defines it.

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
        noise: LineNoise,
        shape: LineShape | None = None,
        device: str | None = None,
        threads: int | None = None,
    ) -> None:
        # Here and not above: Warp takes a second to load, and the types are used without it.
        import warp as wp

        from compute.signal.fit.fit_kernel import fit_peaks, fitted_line_record
        from compute.signal.native.runner import LineRunner

        search = settings.search
        record = fitted_line_record(search.max_peaks)
        self.settings = settings
        # Kept: the launches have its address.
        self._plan: Any = wp.array(
            pack_plan(settings, LineShape.gaussian() if shape is None else shape),
            dtype=wp.uint64,
            device=warp_device(wp, device),
        )
        self._runner = LineRunner(
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
        )

    @property
    def device(self) -> str:
        """Name of the device."""
        return self._runner.device

    def find(self, lines: NDArray[np.uint16]) -> PeakBatch:
        """Fit the peaks of lines, uint16, shape (L, P), with L at most the finder's ``lines``.

        Only the returned arrays are allocated (and a copy, where the rows do not lie one after
        another in memory).

        Raises:
            InvalidParameter: another type or shape.
        """
        return _batch_of(self._runner.find(lines))

    def upload(self, lines: NDArray[np.uint16]) -> None:
        """Bring lines to the device; on the CPU they stay where they are, until ``launch``.

        ``find`` is upload, launch and download; apart, they time the kernel alone.
        """
        self._runner.upload(lines)

    def launch(self, count: int) -> None:
        """Start the kernel on the first ``count`` of the uploaded lines.

        Raises:
            InvalidParameter: there are not so many.
        """
        self._runner.launch(count)

    def download(self, count: int) -> PeakBatch:
        """Wait for the kernel and return the peaks of the first ``count`` lines."""
        return _batch_of(self._runner.download(count))


def _batch_of(records: NDArray[np.void]) -> PeakBatch:
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
