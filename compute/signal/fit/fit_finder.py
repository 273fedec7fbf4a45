"""FitFinder: fits the peaks of batches of lines on one device, in buffers of its own."""

import numpy as np
from numpy.typing import NDArray

from compute.signal.batch_finder import BatchFinder, search_arguments
from compute.signal.fit.fit_plan import pack_plan
from compute.signal.fit.settings import FitSettings
from compute.signal.fit.shape import LineShape
from compute.signal.noise import LineNoise
from compute.signal.peaks import PeakBatch


class FitFinder(BatchFinder):
    """Search and weighted fit of many lines at once by Warp; ``FitSettings`` defines it.

    Warp is not thread-safe: one thread makes the finder and calls it. Making it loads Warp and
    compiles the kernels, unless an earlier process has (seconds to a minute); ``find`` does
    neither.

    Args:
        lines: most lines of one call.
        pixels: pixels of each line, 64 to 65536.
        settings: how lines are fitted.
        noise: noise of the S sensors; line l of a batch is of sensor ``l % S``, so that frames
            of shape (S, P) may be put one after another.
        shape: how a line's light is spread; None: a Gaussian.
        device: "cpu", "cuda:0", ...; None takes the first CUDA device, or else the CPU.

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
    ) -> None:
        room = settings.search.max_peaks
        # Here and not above: it loads Warp.
        from compute.signal.centroid_kernel import CUDA_LANES, line_record
        from compute.signal.fit.fit_kernel import find_candidates, fit_peaks, fitted_line_record

        candidate, record = line_record(room), fitted_line_record(room)
        super().__init__(lines, pixels, record, device)
        self.settings = settings
        # Kept: the recorded launches have their addresses.
        self._noise = self._noise_arrays(noise)
        self._plan = self._wp.array(
            pack_plan(settings, LineShape.gaussian() if shape is None else shape),
            dtype=self._wp.uint64,
            device=self._device,
        )
        self._candidates = self._wp.zeros(
            candidate.itemsize * lines // 8, dtype=self._wp.uint64, device=self._device
        )
        lanes = CUDA_LANES if self._cuda else 1
        found = [self._candidates.ptr, candidate.itemsize]
        self._record_launch(
            find_candidates,
            lanes,
            [pixels, lanes, *self._noise, *search_arguments(settings.search), *found],
        )
        fitted = [self._records.ptr, record.itemsize]
        self._record_launch(
            fit_peaks, 1, [pixels, *self._noise, room, self._plan.ptr, *found, *fitted]
        )

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
