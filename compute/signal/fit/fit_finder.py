"""Peak finder by weighted fit, compiled by Warp for one device."""

from typing import Final

from compute.signal.fit.fit_settings import FitSettings
from compute.signal.fit.line_spread_function import LineSpreadFunction
from compute.signal.fit.native.definitions import fitted_scan_record, pack_plan
from compute.signal.native.definitions import FIT_SCANS_PER_WARP
from compute.signal.peak_finder import PeakFinder
from compute.signal.pixel_corrections import PixelCorrections
from compute.signal.sensor_noise import SensorNoise

PIXELS_PER_THREAD: Final = 786_432
"""Smallest share of pixels for which another CPU thread pays."""


class FitFinder(PeakFinder):
    """Search and weighted fit of many scans at once by Warp; ``FitSettings`` defines it.

    Args:
        max_scans: largest number of scans of one call.
        pixels: pixels of each scan, 64 to 65536.
        settings: how scans are fitted.
        noise: of the S sensors; scan l of a batch is of sensor ``l % S``.
        shape: the line-spread function; None: a Gaussian.
        device: "cpu", "cuda:0", ...; None takes the first CUDA device, or else the CPU.
        threads: largest number of CPU threads for a batch; None: as many as there are CPUs.
        corrections: of the sensors' pixels; None: counts are taken as they are.

    Raises:
        InvalidParameter: a size outside its range, or a device that is not there.
    """

    def __init__(
        self,
        max_scans: int,
        pixels: int,
        settings: FitSettings,
        noise: SensorNoise,
        shape: LineSpreadFunction | None = None,
        device: str | None = None,
        threads: int | None = None,
        corrections: PixelCorrections | None = None,
    ) -> None:
        super().__init__(
            "fit",
            max_scans,
            pixels,
            settings.search,
            noise,
            fitted_scan_record(settings.search.max_peaks),
            device,
            threads,
            scans_per_warp=FIT_SCANS_PER_WARP,
            pixels_per_thread=PIXELS_PER_THREAD,
            corrections=corrections,
            plan=pack_plan(settings, shape or LineSpreadFunction.gaussian()),
        )
