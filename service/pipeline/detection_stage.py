"""DetectionStage: peaks of a device's scans, by the method that its description asks for."""

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from math import inf, log, sqrt
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter, LumilineError
from compute.measurement.flag_policy import STANDARD_POLICY, FlagPolicy
from compute.optics.profiles.device_profile import DeviceProfile
from compute.optics.profiles.profile_loader import load_profile, profile_names
from compute.optics.profiles.profile_optics import window_shadows
from compute.planning.volume_scans import VolumeScans, volume_scans
from compute.signal.centroid_finder import CentroidFinder
from compute.signal.centroid_settings import CentroidSettings
from compute.signal.coded_aperture.shadow_fit import MaskReader, ShadowSettings
from compute.signal.coded_aperture.shadow_template import ShadowTemplate
from compute.signal.fit.device_line_spread import device_line_spread
from compute.signal.fit.fit_finder import FitFinder
from compute.signal.fit.fit_settings import WIDTH_LIMITS_PX, FitSettings
from compute.signal.fit.line_spread_function import LineSpreadFunction
from compute.signal.peaks import PeakBatch, PeakFlag, no_peaks
from compute.signal.pixel_corrections import PixelCorrections, calibrated_noise
from compute.signal.radiometric_calibration import RadiometricCalibration
from compute.signal.sensor_noise import SensorNoise
from hardware.driver import DeviceDescription
from service.pipeline.active_calibration import LiveBadPixel, bad_pixel_flags
from service.problems.errors import UnknownDeviceProfile

_log = logging.getLogger(__name__)

FindProfile = Callable[[str], DeviceProfile]


@dataclass(frozen=True, eq=False)
class ExpectedScans:
    """Expected scans by the device's profile: shapes and shadow templates for measuring peaks.

    Args:
        volume: noiseless light lines of its volume with their true readings; None: not known.
        templates: shadows of its coded windows, by sensor; empty where it has none.
    """

    volume: VolumeScans | None = None
    templates: tuple[ShadowTemplate, ...] = ()


def built_in_profile(name: str) -> DeviceProfile:
    """Return a built-in profile; a recording's name for one is no path.

    Raises:
        UnknownDeviceProfile: there is none of the name.
    """
    if name not in profile_names():
        raise UnknownDeviceProfile(
            f'there is no built-in device profile "{name}"; there are {", ".join(profile_names())}',
            name=name,
        )
    return load_profile(name)


def expected_scans(
    description: DeviceDescription, find_profile: FindProfile = built_in_profile
) -> ExpectedScans:
    """Return the expected scans of a device; takes tenths of a second, and no Warp.

    They are empty for a profile that is gone, or of another device meanwhile; the log says so.
    """
    if description.profile is None or description.readout in ("gray-tracks", "bar-peaks"):
        return ExpectedScans()
    try:
        profile = find_profile(description.profile)
        if not _is_of(profile, description):
            _log.warning("device %s: profile %s is of other sensors, and not used",
                         description.name, profile.name)  # fmt: skip
            return ExpectedScans()
        if description.readout == "coded-window":
            return ExpectedScans(templates=window_shadows(profile))
        return ExpectedScans(volume_scans(profile))
    except LumilineError as error:
        _log.warning("device %s: its profile tells nothing of its lines: %s",
                     description.name, error.detail)  # fmt: skip
        return ExpectedScans()


def _is_of(profile: DeviceProfile, description: DeviceDescription) -> bool:
    pixels = {sensor.pixels for sensor in description.sensors}
    names = [sensor.name for sensor in description.sensors]
    return names == [sensor.name for sensor in profile.sensors] and pixels == {profile.pixels.count}


Array = NDArray[np.float64]

Method = Literal["fit", "centroid", "shadow", "fused"]

_SEARCH: Final = CentroidSettings(threshold_fraction=0.1, min_width_px=2)
"""How lines to fit are found. At a tenth of its height a line is two pixels wide, unless nearly all
of its light is in one, and a hot pixel is not. At a third, many a sharp line has one pixel."""

_TO_THIRD: Final = sqrt(
    log(CentroidSettings().threshold_fraction) / log(_SEARCH.threshold_fraction)
)
"""The width of a Gaussian at a third of its height over that at the search's threshold."""

FREE_WIDTH_FIT: Final = FitSettings(search=_SEARCH, width_log_sigma=inf, further_peaks=False)
"""For lines of no known shape: Gaussians of any width, one for each line that is found. Further
ones would explain the tails of one line by more lines: 83 % of the noiseless lines of the profile
bar are then split, and off by 0.89 px RMS instead of 0.011 (printed by
tests/service/pipeline/test_peak_methods.py)."""

_Find = Callable[[NDArray[np.uint16]], PeakBatch]


@dataclass(frozen=True, eq=False)
class SearchModel:
    """Noise, search, fit and line shape that a device's peaks are measured with.

    Args:
        noise: of the sensors.
        search: how candidates are found; None: shadows, or nothing reads the scans.
        fit: how they are fitted; None: they are not.
        shape: the line-spread function; None: a Gaussian.
        corrections: of the sensors' pixels; None: counts are taken as they are.
    """

    noise: SensorNoise
    search: CentroidSettings | None = None
    fit: FitSettings | None = None
    shape: LineSpreadFunction | None = None
    corrections: PixelCorrections | None = None


def peak_method(description: DeviceDescription) -> Method | None:
    """Return the method by which a device's peaks are measured; None: nothing reads its scans.

    Stripes too wide or too narrow to be fitted are measured by their centroid.
    """
    if description.readout == "gray-tracks":
        return None
    if description.readout == "bar-peaks":
        return "fused"
    if description.readout == "coded-window":
        return "shadow"
    low, high = WIDTH_LIMITS_PX
    sigma = description.line_sigma_px
    if description.peaks == "fit" and (sigma is None or low <= sigma <= high):
        return "fit"
    return "centroid"


class DetectionStage:
    """Finds the peaks in the scans of all S sensors of a device.

    Lines and shadows are never quite what is fitted, and what that costs is in the standard
    deviations. Light lines: what the method errs by over the volume of the device's profile, RMS
    by sensor, added in squares; where no fit was possible, what those err by. Shadows: where the
    chi-square per degree of freedom is above one, its root as a factor (R. T. Birge,
    10.1103/PhysRev.40.207); behind the windows of the profile coda-mpx30 the errors are then 0.7
    deviations RMS, and 2.7 at most. The positions are those of the calibrations: a Gaussian at a
    whole light line's centre of gravity; what it misses of that in lines with coma is part of the
    error (printed by tests/service/pipeline/test_peak_methods.py). Widths are those at a third of
    the height, by whatever method.

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
        model: ExpectedScans,
        compute_device: str | None = None,
    ) -> None:
        self.method = peak_method(description)
        self.error_px: Array | None = None
        """RMS error over the volume, shape (S,) [px]; None: not known."""
        self.unfitted_error_px = 0.0
        """That of peaks that were not fitted, of all sensors; 0 where all are."""
        sensors, pixels = len(description.sensors), description.sensors[0].pixels
        self._pixels = {sensor.name: sensor.pixels for sensor in description.sensors}
        self._search_model = partial(_search_model, self.method, description, model)
        self._make_find = partial(
            _find, self.method, frames * sensors, pixels, model.templates, compute_device
        )
        self.search_model = self._search_model([None] * sensors, [np.empty(0, np.intp)] * sensors)
        """What peaks are found with now; replaced as a whole, so that it may be read."""
        self._find = self._make_find(self.search_model)
        if self._find is not None:
            # Loads the kernel and touches the buffers, before the first frame waits for it.
            self._find(np.zeros((sensors, pixels), np.uint16))
            if model.volume is not None:
                self.error_px, self.unfitted_error_px = _rms_errors(
                    self._find, model.volume, frames
                )
        self.flag_policy = (
            STANDARD_POLICY
            if self.method is None
            # The bars' method, whose errors by shape are in their peaks' standard deviations.
            else FlagPolicy.of_method(description.peaks, known_shape=False)
            if self.method == "fused"
            else FlagPolicy.of_method(self.method, known_shape=self.error_px is not None)
        )
        """What the peaks' flags mean for points, tracks and tools."""

    def set_pixels(
        self,
        calibrations: Mapping[str, RadiometricCalibration],
        bad_pixels: Sequence[LiveBadPixel] = (),
    ) -> None:
        """Find peaks with radiometric calibrations, and without bad pixels.

        Takes milliseconds: the kernels are loaded already, and buffers are made anew.

        Args:
            calibrations: radiometric calibrations of sensors, by name; empty: none.
            bad_pixels: pixels that are masked beside those of the calibrations.

        Raises:
            InvalidParameter: a calibration is of no sensor of the device, or of other pixels, or
                a bad pixel is none of the device's.
        """
        for name, one in calibrations.items():
            if self._pixels.get(name) != one.pixels:
                listed = ", ".join(
                    f"{sensor_name} ({count} px)" for sensor_name, count in self._pixels.items()
                )
                raise InvalidParameter(
                    f"the radiometric calibration is of {name} ({one.pixels} px); the device has "
                    f"{listed}"
                )
        unknown = {one.sensor for one in bad_pixels} - self._pixels.keys()
        if unknown:
            raise InvalidParameter(
                f"bad pixels are of {', '.join(sorted(unknown))}; the device has "
                f"{', '.join(self._pixels)}"
            )
        masked = [
            np.flatnonzero(bad_pixel_flags(bad_pixels, name, count))
            for name, count in self._pixels.items()
        ]
        if self._find is None:
            return
        search_model = self._search_model([calibrations.get(name) for name in self._pixels], masked)
        find = self._make_find(search_model)
        assert find is not None
        find(np.zeros((len(self._pixels), next(iter(self._pixels.values()))), np.uint16))
        self._find, self.search_model = find, search_model

    @property
    def reads(self) -> bool:
        """Whether a method reads the scans of this device, or its peaks come without scans."""
        return self._find is not None or self.method == "fused"

    def settings(self) -> dict[str, Any]:
        """Return the method and its errors as a JSON object, for recordings."""
        return {
            "method": self.method,
            "error_px": None if self.error_px is None else self.error_px.tolist(),
            "unfitted_error_px": self.unfitted_error_px,
        }

    def find(self, lines: NDArray[np.uint16]) -> PeakBatch:
        """Return the peaks of the lines of F frames, uint16, shape (F x S, P)."""
        if self._find is None:
            return no_peaks(len(lines))
        peaks = self._find(lines)
        if self.method == "shadow":
            stretch = np.sqrt(np.maximum(peaks.reduced_chi2, np.float32(1.0)))
            return replace(peaks, sigma_px=peaks.sigma_px * stretch)
        changed: dict[str, Any] = {}
        if self.method == "fit":
            changed["width_px"] = peaks.width_px * np.float32(_TO_THIRD)
        if self.error_px is not None:
            # By frame, sensor and peak for the errors, which are by sensor.
            sigma = peaks.sigma_px.reshape(-1, len(self.error_px), peaks.sigma_px.shape[1])
            error: Array | np.float64 = self.error_px[:, None]
            unfitted = (peaks.flags & int(PeakFlag.UNFITTED)) != 0
            if np.count_nonzero(unfitted):
                error = np.where(unfitted.reshape(sigma.shape), self.unfitted_error_px, error)
            widened = np.hypot(sigma, error, dtype=np.float64).astype(np.float32)
            changed["sigma_px"] = widened.reshape(peaks.sigma_px.shape)
        return replace(peaks, **changed) if changed else peaks


def nominal_search_model(description: DeviceDescription) -> SearchModel:
    """Return what a device's peaks are found with while no radiometric calibration is active."""
    sensors = len(description.sensors)
    return _search_model(
        peak_method(description),
        description,
        ExpectedScans(),
        [None] * sensors,
        [np.empty(0, np.intp)] * sensors,
    )


def _search_model(
    method: Method | None,
    description: DeviceDescription,
    model: ExpectedScans,
    calibrations: Sequence[RadiometricCalibration | None],
    masked: Sequence[NDArray[np.intp]],
) -> SearchModel:
    """Return what a device's peaks are found with.

    Args:
        method: how.
        description: the device.
        model: what is known of its lines.
        calibrations: radiometric ones of the sensors; None for one without.
        masked: further bad pixels of each sensor.
    """
    sensors, pixels = len(description.sensors), description.sensors[0].pixels
    noise = SensorNoise.of(
        [description.electrons_per_count] * sensors,
        description.read_noise_electrons,
        description.offset_counts,
        2**description.bits - 1,
    )
    corrections = None
    if any(one is not None for one in calibrations) or any(len(one) for one in masked):
        noise = calibrated_noise(calibrations, noise)
        corrections = PixelCorrections.of(calibrations, pixels, description.offset_counts)
        for number, bad in enumerate(masked):
            corrections = corrections.with_masked(number, bad)
    if method == "centroid":
        return SearchModel(noise, CentroidSettings(), corrections=corrections)
    if method != "fit":
        return SearchModel(noise, corrections=corrections)
    sigma = description.line_sigma_px
    settings = (
        FREE_WIDTH_FIT
        if sigma is None
        else FitSettings(search=_SEARCH, width_px=sigma, width_log_sigma=0.0)
    )
    # Where the lines of the volume are known, ``error_px`` holds what their shape costs.
    settings = replace(settings, widen_misfit=model.volume is None)
    shape = None
    if any(one is not None and one.line_shape is not None for one in calibrations):
        shape, unit_px = device_line_spread(
            [None if one is None else one.line_shape for one in calibrations], sigma
        )
        settings = replace(settings, width_px=unit_px)
    return SearchModel(noise, settings.search, settings, shape, corrections)


def _find(
    method: Method | None,
    lines: int,
    pixels: int,
    templates: tuple[ShadowTemplate, ...],
    compute_device: str | None,
    model: SearchModel,
) -> _Find | None:
    """Return what finds the peaks; None: nothing does.

    Args:
        method: how.
        lines: most scans of one call.
        pixels: of each scan.
        templates: shadows of coded windows, by sensor.
        compute_device: as of FitFinder.
        model: what they are found with.
    """
    noise, corrections = model.noise, model.corrections
    if method == "fit":
        assert model.fit is not None
        return FitFinder(
            lines, pixels, model.fit, noise, model.shape, compute_device, corrections=corrections
        ).find
    if method == "centroid":
        assert model.search is not None
        return CentroidFinder(
            lines, pixels, model.search, noise, device=compute_device, corrections=corrections
        ).find
    if method == "shadow" and templates:
        read = MaskReader(templates, pixels, noise, ShadowSettings(fit_scale=True)).read
        return read if corrections is None else partial(_read_corrected, read, corrections)
    return None


def _read_corrected(
    read: _Find, corrections: PixelCorrections, lines: NDArray[np.uint16]
) -> PeakBatch:
    """Read shadows in corrected scans, rounded to counts; masked pixels are interpolated."""
    corrected = np.rint(corrections.correct(lines)).clip(0.0, 65535.0)
    return read(corrected.astype(np.uint16))


def _rms_errors(find: _Find, volume: VolumeScans, frames: int) -> tuple[Array | None, float]:
    """Return the RMS errors of a volume's noiseless lines [px].

    Those of the fitted (or centres of gravity) by sensor, None where one sees nothing; and those of
    all that were not fitted, 0 where all are.
    """
    all_errors, fitted_errors = [], []
    for part in volume.parts(frames):
        peaks = find(part.lines)
        all_errors.append(part.errors_px(peaks))
        fitted_errors.append(part.errors_px(peaks, PeakFlag.CLIPPED | PeakFlag.UNFITTED))
    fitted = np.concatenate(fitted_errors)
    if not np.isfinite(fitted).any(axis=0).all():
        return None, 0.0
    unfitted = np.concatenate(all_errors)[np.isnan(fitted)]
    unfitted = unfitted[np.isfinite(unfitted)]
    rms = np.sqrt(np.nanmean(fitted**2, axis=0))
    return np.asarray(rms), float(np.sqrt(np.mean(unfitted**2))) if len(unfitted) else 0.0
