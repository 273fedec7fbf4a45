"""VolumeScans: noiseless scans of points over a profile's volume with their true readings.

They measure the systematic error of a peak estimator, which depends on the position and is the same
in every exposure.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from compute.optics.coded_aperture.gray_plate import TrackOptics
from compute.optics.coded_aperture.mask_optics import MaskOptics
from compute.optics.pixel_solid_angles import scan_electrons
from compute.optics.profiles.device_profile import DeviceProfile
from compute.optics.profiles.profile_optics import light_source, profile_optics
from compute.planning.cramer_rao import centroids
from compute.signal.peaks import PeakBatch, PeakFlag

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class VolumeScans:
    """Noiseless scans of N points, evenly spread over a volume, on S sensors.

    Args:
        lines: counts without noise, uint16, shape (N x S, P), point by point.
        readings_px: the true readings, the centres of gravity of whole light lines, shape (N, S)
            [px]; NaN where nothing is seen.
        full_counts: the count from which on a pixel says "at least" only.
    """

    lines: NDArray[np.uint16]
    readings_px: Array
    full_counts: int

    def parts(self, points: int) -> Iterator["VolumeScans"]:
        """Yield the scans in parts of at most ``points`` points."""
        sensors = self.readings_px.shape[1]
        for first in range(0, len(self.readings_px), points):
            part = slice(first, first + points)
            lines = self.lines[first * sensors : (first + points) * sensors]
            yield VolumeScans(lines, self.readings_px[part], self.full_counts)

    def errors_px(self, peaks: PeakBatch, without: PeakFlag = PeakFlag.CLIPPED) -> Array:
        """Return the errors of the brightest peaks of these scans, shape (N, S) [px].

        NaN where there is none, of lines with full pixels, and of peaks with one of the flags
        ``without``.

        Args:
            peaks: peaks found in the scans.
            without: flags of peaks that are left out.
        """
        points, sensors = self.readings_px.shape
        detected = np.isfinite(peaks.position_px)
        row = np.arange(points * sensors)
        brightest = np.where(detected, peaks.amplitude, -1.0).argmax(axis=1)
        error = peaks.position_px[row, brightest] - self.readings_px.ravel()
        full = self.lines.max(axis=1) >= self.full_counts
        error[full | ((peaks.flags[row, brightest] & without) != 0)] = np.nan
        return np.asarray(error.reshape(points, sensors))


def volume_scans(profile: DeviceProfile, per_side: int = 5) -> VolumeScans:
    """Trace the noiseless scans of a profile's markers; takes up to a second.

    Pixels respond as unevenly as the profile's do, other ones to each line: that too is an error by
    place.

    Args:
        profile: the device.
        per_side: points along each side of its volume, in the middles of equal parts.

    Raises:
        InvalidParameter: no point, or the profile has no lenses, or Gray tracks behind them.
    """
    optics = profile_optics(profile, "exact")
    if isinstance(optics, MaskOptics | TrackOptics):
        raise InvalidParameter(
            f"profile {profile.name} has coded windows or Gray tracks; light lines are the images "
            "of lenses on pixels",
            profile_id=profile.name,
        )
    if per_side < 1:
        raise InvalidParameter(f"per_side is {per_side}; it must be 1 or more", per_side=per_side)
    share = (np.arange(per_side) + 0.5) / per_side - 0.5
    grid = np.stack(np.meshgrid(share, share, share, indexing="ij"), axis=-1).reshape(-1, 3)
    points = np.array(profile.volume.centre_mm) + grid * np.array(profile.volume.size_mm)
    pixels = profile.pixels.count
    solid_angles = optics.solid_angles(points)
    readings, light = centroids(solid_angles, pixels)
    readings = np.where(light > 0.0, readings, np.nan)
    exposure_s = profile.rates.exposure_s
    photons = light_source(profile).photons_per_sr(
        points, None, np.array([sensor.position_mm for sensor in profile.sensors]), exposure_s
    )
    sensor_detector = profile.detector
    signal = scan_electrons(solid_angles, photons * sensor_detector.quantum_efficiency, 1, pixels)
    detector = sensor_detector.detector(exposure_s)
    uneven = np.random.default_rng(0).normal(1.0, detector.response_nonuniformity, signal.shape)
    electrons = signal * uneven + detector.ambient_electrons + detector.dark_electrons
    counts = electrons / sensor_detector.electrons_per_count + sensor_detector.offset_counts
    lines = np.rint(np.clip(counts, 0, detector.full_counts)).astype(np.uint16)
    return VolumeScans(lines.reshape(-1, pixels), readings, detector.full_counts)
