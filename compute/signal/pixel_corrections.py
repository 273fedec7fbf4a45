"""PixelCorrections: offset, response and bad pixels of a device's sensors, applied to counts."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from compute.signal.centroid_settings import GROUP_PIXELS, SAMPLE_GROUPS, sample_starts
from compute.signal.native.definitions import PIXEL_CORRECTION, SENSOR_CORRECTION
from compute.signal.radiometric_calibration import RadiometricCalibration
from compute.signal.sensor_noise import SensorNoise

Float32 = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class PixelCorrections:
    """Corrections of the counts of S sensors with P pixels; scan l is of sensor ``l % S``.

    With ``y = v - dark`` the count of a mean pixel under the same light is
    ``y (1 + y (bends[0] + y bends[1])) scale + offset``, in float32.

    Args:
        dark: counts without light, shape (S, P).
        scale: reciprocals of the responses; 0: the pixel is masked, shape (S, P).
        offset: mean counts without light, which the corrected counts keep, shape (S,).
        bends: coefficients of the nonlinearity, shape (S, 2).
    """

    dark: Float32
    scale: Float32
    offset: Float32
    bends: Float32

    @classmethod
    def of(
        cls,
        calibrations: Sequence[RadiometricCalibration | None],
        pixels: int,
        offset_counts: float = 0.0,
    ) -> "PixelCorrections":
        """Return the corrections of calibrated sensors; None stands for one that is not.

        Args:
            calibrations: of the S sensors.
            pixels: P.
            offset_counts: count without light of sensors without a calibration.

        Raises:
            InvalidParameter: a calibration of another number of pixels.
        """
        shape = (len(calibrations), pixels)
        dark, scale = np.full(shape, offset_counts, np.float32), np.ones(shape, np.float32)
        offset = np.full(len(calibrations), offset_counts, np.float32)
        bends = np.zeros((len(calibrations), 2), np.float32)
        for number, one in enumerate(calibrations):
            if one is None:
                continue
            if one.pixels != pixels:
                raise InvalidParameter(
                    f"the radiometric calibration of sensor {number} has {one.pixels} pixels; the "
                    f"sensor has {pixels}",
                    sensor=number,
                )
            good = one.good
            dark[number] = np.nan_to_num(one.dark_offset)
            scale[number, good] = 1.0 / one.response[good]
            scale[number, ~good] = 0.0
            offset[number] = one.mean_offset_counts
            bends[number] = one.linearity
        return cls(dark, scale, offset, bends)

    def with_masked(self, sensor: int, pixels: NDArray[np.int64]) -> "PixelCorrections":
        """Return corrections with further pixels of a sensor masked.

        Args:
            sensor: its number.
            pixels: the pixels' numbers.
        """
        scale = self.scale.copy()
        scale[sensor, pixels] = 0.0
        return PixelCorrections(self.dark, scale, self.offset, self.bends)

    def __len__(self) -> int:
        """Return S."""
        return len(self.dark)

    @property
    def masked(self) -> NDArray[np.bool_]:
        """Pixels that no measurement uses, shape (S, P)."""
        return np.asarray(self.scale == 0.0)

    def correct(self, scans: NDArray[np.uint16]) -> Float32:
        """Return corrected counts of scans, shape (L, P); masked pixels are interpolated."""
        sensor = np.arange(len(scans)) % len(self)
        signal = scans.astype(np.float32) - self.dark[sensor]
        first, second = self.bends[sensor].T[..., None]
        light = signal * (np.float32(1.0) + signal * (first + signal * second))
        corrected: Float32 = light * self.scale[sensor] + self.offset[sensor, None]
        for row, number in enumerate(sensor):
            bad = np.flatnonzero(self.scale[number] == 0.0)
            if not bad.size:
                continue
            good = np.flatnonzero(self.scale[number] != 0.0)
            if not good.size:
                corrected[row] = self.offset[number]
                continue
            next_good = np.searchsorted(good, bad)
            above = good[np.minimum(next_good, len(good) - 1)]
            below = good[np.maximum(next_good - 1, 0)]
            span = np.maximum(above - below, 1).astype(np.float32)
            part = np.clip((bad - below).astype(np.float32) / span, 0, 1).astype(np.float32)
            low = np.where(next_good == 0, corrected[row, above], corrected[row, below])
            high = np.where(next_good == len(good), low, corrected[row, above])
            corrected[row, bad] = low + (high - low) * part
        return corrected

    def group_shifts(self) -> NDArray[np.int32]:
        """Return what the dark counts of the background's groups are above the mean, (S, 32)."""
        starts = np.array(sample_starts(self.dark.shape[1]))
        above = self.dark.astype(np.float64) - self.offset[:, None]
        groups = above[:, starts[:, None] + np.arange(GROUP_PIXELS)].sum(axis=2)
        shifts = np.zeros((len(self), SAMPLE_GROUPS), np.int32)
        shifts[:, : len(starts)] = np.rint(groups)
        return shifts

    def pack(self) -> NDArray[np.uint64]:
        """Return what the kernels read: sensors, then their pixels, in 64-bit words."""
        sensors = np.zeros(len(self), SENSOR_CORRECTION.dtype)
        sensors["offset"] = self.offset
        sensors["first_bend"], sensors["second_bend"] = self.bends.T
        sensors["group_shifts"] = self.group_shifts()
        pixels = np.zeros(self.dark.shape, PIXEL_CORRECTION.dtype)
        pixels["dark"], pixels["scale"] = self.dark, self.scale
        packed = sensors.tobytes() + pixels.tobytes()
        return np.frombuffer(packed + bytes(-len(packed) % 8), np.uint64).copy()


def calibrated_noise(
    calibrations: Sequence[RadiometricCalibration | None], noise: SensorNoise
) -> SensorNoise:
    """Return the noise of sensors: by their calibrations, and as given where there is none.

    Args:
        calibrations: of the S sensors.
        noise: of the sensors by their data sheet.

    Raises:
        InvalidParameter: another number of sensors.
    """
    if len(calibrations) != len(noise):
        raise InvalidParameter(
            f"there are {len(calibrations)} radiometric calibrations for {len(noise)} sensors; "
            "there must be one, or None, for each"
        )
    columns = [
        (
            one.gain_electrons_per_count,
            one.read_noise_electrons,
            one.mean_offset_counts,
            float(one.saturation_counts),
        )
        if one is not None
        else (
            float(noise.electrons_per_count[number]),
            float(noise.read_noise_electrons[number]),
            float(noise.offset_counts[number]),
            float(noise.full_scale_counts[number]),
        )
        for number, one in enumerate(calibrations)
    ]
    return SensorNoise.of(*zip(*columns, strict=True))
