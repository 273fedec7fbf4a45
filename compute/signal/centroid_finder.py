"""Peak finder by threshold and centre of gravity, compiled by Warp for one device."""

from typing import Final

from compute.signal.centroid_settings import CentroidSettings
from compute.signal.native.definitions import (
    BLOCK_PIXELS,
    LONG_SCANS_PER_WARP,
    SCANS_PER_BATCH,
    SHORT_PIXELS,
    scan_record,
)
from compute.signal.peak_finder import PeakFinder
from compute.signal.pixel_corrections import PixelCorrections
from compute.signal.sensor_noise import SensorNoise

PIXELS_PER_THREAD: Final = 2_097_152
"""A further CPU thread pays from twice as many pixels on: a scan takes 0.3 us, waking it tens."""


class CentroidFinder(PeakFinder):
    """Threshold and centre of gravity of many scans at once (thesis [4.1], 4.2.2) by Warp.

    Args:
        max_scans: largest number of scans of one call.
        pixels: pixels of each scan, 64 to 65536.
        settings: what counts as a peak; CentroidSettings has the definition.
        noise: of the S sensors; scan l of a batch is of sensor ``l % S``.
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
        settings: CentroidSettings,
        noise: SensorNoise,
        device: str | None = None,
        threads: int | None = None,
        corrections: PixelCorrections | None = None,
    ) -> None:
        short = pixels <= SHORT_PIXELS
        blocks = -(-pixels // BLOCK_PIXELS)
        super().__init__(
            "block" if blocks == 1 else "at_most_short" if short else "longer",
            max_scans,
            pixels,
            settings,
            noise,
            scan_record(settings.max_peaks),
            device,
            threads,
            scans_per_warp=SCANS_PER_BATCH // blocks if short else LONG_SCANS_PER_WARP,
            pixels_per_thread=PIXELS_PER_THREAD,
            corrections=corrections,
            reads_once=short,
        )
