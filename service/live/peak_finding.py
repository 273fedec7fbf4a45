"""PeakFinding: the peaks of a device's lines, by the method that its description asks for."""

from collections.abc import Callable
from dataclasses import replace
from math import inf
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from compute.planning.volume_lines import VolumeLines
from compute.signal.finder import CentroidFinder
from compute.signal.fit.fit_finder import FitFinder
from compute.signal.fit.settings import WIDTH_LIMITS_PX, FitSettings
from compute.signal.masks.reader import MaskReader
from compute.signal.masks.settings import ShadowSettings
from compute.signal.noise import LineNoise
from compute.signal.peaks import PeakBatch, PeakFlag, no_peaks
from compute.signal.settings import CentroidSettings
from hardware.driver import DeviceDescription
from service.live.frame_points import PeakUse
from service.live.line_model import LineModel

Array = NDArray[np.float64]

Method = Literal["fit", "centroid", "shadow"]

FREE_SHAPE: Final = FitSettings(width_spread=inf, max_joint=1)
"""For lines of no known shape: a Gaussian of any width for each. Several fitted together would
explain the tails of one line by more lines: with up to four, 81 % of the noiseless lines of the
profile bar are split, and off by 0.89 px RMS instead of 0.027 (printed by
tests/service/live/test_peak_methods.py)."""

_Find = Callable[[NDArray[np.uint16]], PeakBatch]


def peak_method(description: DeviceDescription) -> Method | None:
    """Return how a device's peaks are measured; None: they are not.

    Lines too wide or too narrow to be fitted are measured by their centre of gravity.
    """
    if description.readout == "gray-tracks":
        return None
    if description.readout == "coded-window":
        return "shadow"
    low, high = WIDTH_LIMITS_PX
    sigma = description.line_sigma_px
    if description.peaks == "fit" and (sigma is None or low <= sigma <= high):
        return "fit"
    return "centroid"


class PeakFinding:
    """Finds the peaks in the lines of all S sensors of a device.

    Lines and shadows are never quite what is fitted, and what that costs is in the standard
    deviations. Light lines: what the method errs by over the volume of the device's profile, RMS
    by sensor, added in squares. Shadows: where the chi-square per degree of freedom is above one,
    its root as a factor (R. T. Birge, 10.1103/PhysRev.40.207); behind the windows of the profile
    coda-mpx30 the errors are then 0.7 deviations RMS, and 2.7 at most. The positions are those of
    the calibrations: a Gaussian at a whole light line's centre of gravity; what it misses of that
    in lines with coma is part of the error (printed by tests/service/live/test_peak_methods.py).

    Loads Warp and its kernels for light lines, and takes what time they need: make it and use it
    in one thread.

    Args:
        description: the device.
        frames: most frames of one call.
        model: what is known of its lines.
        compute_device: as of FitFinder.
    """

    def __init__(
        self,
        description: DeviceDescription,
        frames: int,
        model: LineModel,
        compute_device: str | None = None,
    ) -> None:
        self.method = peak_method(description)
        self.error_px: Array | None = None
        """RMS error over the volume, shape (S,) [px]; None: not known."""
        sensors, pixels = len(description.sensors), description.sensors[0].pixels
        self._find = _find(self.method, description, frames, model, compute_device)
        if self._find is not None:
            # Loads the kernel and touches the buffers, before the first frame waits for it.
            self._find(np.zeros((sensors, pixels), np.uint16))
            if model.volume is not None:
                self.error_px = _rms_error(self._find, model.volume, frames)
        shadow = self.method == "shadow"
        doubtful = PeakFlag.SATURATED | PeakFlag.MERGED | PeakFlag.UNFITTED | PeakFlag.AMBIGUOUS
        if self.error_px is None and not shadow:
            # Nothing else tells what a wrong shape costs.
            doubtful |= PeakFlag.POOR_FIT
        # A line of light that runs over the sensor's end is drawn inwards by far more than its
        # noise; a shadow is not.
        self.use = PeakUse(PeakFlag.NONE if shadow else PeakFlag.CLIPPED, doubtful)
        """What the peaks' flags mean for points."""

    @property
    def reads(self) -> bool:
        """Whether there are ever any peaks."""
        return self._find is not None

    def find(self, lines: NDArray[np.uint16]) -> PeakBatch:
        """Return the peaks of the lines of F frames, uint16, shape (F x S, P)."""
        if self._find is None:
            return no_peaks(len(lines))
        peaks = self._find(lines)
        if self.method == "shadow":
            stretch = np.sqrt(np.maximum(peaks.reduced_chi2, np.float32(1.0)))
            return replace(peaks, sigma_px=peaks.sigma_px * stretch)
        if self.error_px is None:
            return peaks
        error = np.tile(self.error_px, len(lines) // len(self.error_px))[:, None]
        sigma = np.hypot(peaks.sigma_px, error).astype(np.float32)
        return replace(peaks, sigma_px=sigma)


def _find(
    method: Method | None,
    description: DeviceDescription,
    frames: int,
    model: LineModel,
    compute_device: str | None,
) -> _Find | None:
    """Return what finds the peaks; None: nothing does."""
    sensors, pixels = len(description.sensors), description.sensors[0].pixels
    noise = LineNoise.of(
        [description.electrons_per_count] * sensors,
        description.read_noise_electrons,
        description.offset_counts,
        2**description.bits - 1,
    )
    lines = frames * sensors
    if method == "fit":
        sigma = description.line_sigma_px
        settings = FREE_SHAPE if sigma is None else FitSettings(width_px=sigma, width_spread=0.0)
        return FitFinder(lines, pixels, settings, noise, device=compute_device).find
    if method == "centroid":
        return CentroidFinder(lines, pixels, CentroidSettings(), noise, device=compute_device).find
    if method == "shadow" and model.templates:
        return MaskReader(model.templates, pixels, noise, ShadowSettings(fit_scale=True)).read
    return None


def _rms_error(find: _Find, volume: VolumeLines, frames: int) -> Array | None:
    """Return the RMS error of a volume's noiseless lines by sensor [px]; None: nothing is seen."""
    errors = np.concatenate([part.errors_px(find(part.lines)) for part in volume.parts(frames)])
    if not np.isfinite(errors).any(axis=0).all():
        return None
    return np.asarray(np.sqrt(np.nanmean(errors**2, axis=0)))
