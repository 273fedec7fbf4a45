"""Noise model of the sensors: gain, read noise, offset, full scale."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from compute.errors import InvalidParameter
from compute.signal.array_rows import ArrayRows

QUANTISATION_VARIANCE = 1.0 / 12.0
"""Variance of rounding to whole counts [counts^2]."""


@dataclass(frozen=True, eq=False)
class SensorNoise(ArrayRows):
    """Noise of S sensors; scan l belongs to sensor ``l % S``.

    A pixel of v counts has the variance ``read^2/gain^2 + (v - offset)/gain + 1/12`` [counts^2]:
    read noise, photon noise and quantisation.

    Args:
        electrons_per_count: gain of the conversion, float64, shape (S,).
        read_noise_electrons: standard deviation of the read noise, float64, shape (S,).
        offset_counts: the count without light, float64, shape (S,).
        full_scale_counts: the count at which a pixel is saturated, int32, shape (S,).
    """

    electrons_per_count: NDArray[np.float64]
    read_noise_electrons: NDArray[np.float64]
    offset_counts: NDArray[np.float64]
    full_scale_counts: NDArray[np.int32]

    @classmethod
    def of(
        cls,
        electrons_per_count: ArrayLike,
        read_noise_electrons: ArrayLike,
        offset_counts: ArrayLike = 0.0,
        full_scale_counts: ArrayLike = 65535,
    ) -> "SensorNoise":
        """Make it from numbers or sequences; one number serves all sensors.

        Args:
            electrons_per_count: gain of the conversion.
            read_noise_electrons: standard deviation of the read noise.
            offset_counts: count without light.
            full_scale_counts: count at which a pixel is saturated.

        Raises:
            InvalidParameter: shapes that do not agree, or a value outside its range.
        """
        parameters = [
            np.atleast_1d(np.asarray(values, dtype=np.float64))
            for values in (
                electrons_per_count,
                read_noise_electrons,
                offset_counts,
                full_scale_counts,
            )
        ]
        shapes = [values.shape for values in parameters]
        length = max(values.size for values in parameters)
        if any(shape not in ((1,), (length,)) for shape in shapes) or 0 in shapes[0]:
            raise InvalidParameter(
                f"noise arrays have shapes {shapes}; give one number or one per sensor",
                shapes=shapes,
            )
        gain, read, offset, full = (
            np.ascontiguousarray(np.broadcast_to(values, (length,))) for values in parameters
        )
        _require("electrons_per_count", gain, gain > 0, "positive")
        _require("read_noise_electrons", read, read >= 0, "zero or more")
        _require("offset_counts", offset, np.abs(offset) <= 65535, "within -65535 .. 65535")
        _require("full_scale_counts", full, (full >= 1) & (full <= 65535), "in 1 .. 65535")
        return cls(gain, read, offset, full.astype(np.int32))

    def __len__(self) -> int:
        """Return the number of sensors."""
        return len(self.electrons_per_count)

    def of_scans(self, sensor: NDArray[np.int64]) -> "ScanNoise":
        """Return the noise of scans of these sensors, shape (N,)."""
        return ScanNoise(
            self.dark_variance[sensor][:, None],
            self.photon_variance[sensor][:, None],
            self.offset_counts[sensor][:, None],
        )

    @property
    def dark_variance(self) -> NDArray[np.float64]:
        """Variance of a pixel without light [counts^2], shape (S,)."""
        return (self.read_noise_electrons / self.electrons_per_count) ** 2 + QUANTISATION_VARIANCE

    @property
    def photon_variance(self) -> NDArray[np.float64]:
        """Variance that each count of light adds [counts], shape (S,)."""
        return 1.0 / self.electrons_per_count


@dataclass(frozen=True, eq=False)
class ScanNoise(ArrayRows):
    """Noise of N scans, or of windows cut out of them.

    Args:
        dark: variance of a pixel without light, shape (N, 1) [counts^2].
        photon: variance that a count of light adds, shape (N, 1) [counts].
        offset: the count without light, shape (N, 1).
    """

    dark: NDArray[np.float64]
    photon: NDArray[np.float64]
    offset: NDArray[np.float64]

    def variance(self, counts: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the variance of pixels of mean counts, shape (N, P) [counts^2]."""
        return self.dark + self.photon * np.maximum(counts - self.offset, 0.0)


def _require(name: str, values: NDArray[np.float64], good: NDArray[np.bool_], meaning: str) -> None:
    bad = np.flatnonzero(~(good & np.isfinite(values)))
    if bad.size:
        row = int(bad[0])
        raise InvalidParameter(
            f"{name} of sensor {row} is {values[row]}; it must be {meaning}",
            parameter=name,
            sensor=row,
            value=float(values[row]),
        )
