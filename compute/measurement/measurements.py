"""Measurements: the peaks of an exposure, weighed once by the flag policy; their noise."""

from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from compute.measurement.flag_policy import STANDARD_POLICY, FlagPolicy

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Measurements:
    """Up to K peaks of each of S sensors, of one exposure or (in front) of F exposures.

    Args:
        position_px: shape (S, K) or (F, S, K) [px]; NaN: no peak, or none that may be used.
        variance_px2: variance of the position, flags weighed, of the same shape; 1 where there
            is no usable peak.
        flags: PeakFlag values, int32; 0 where there is no peak.
        can_initiate: whether a track or the acquisition of a tool may rest on it.
        suspect: whether points and tracks from it are marked ``suspect-peak``.
        shared: whether it may be the peak of two markers.
        found_px: positions of all peaks, refused ones included [px].
        amplitude: maximum above the background [counts]; 0 where not known.
        original_index: index of each peak before ``sort``, shape (S, K); None: not sorted.
    """

    position_px: Array
    variance_px2: Array
    flags: NDArray[np.int32]
    can_initiate: NDArray[np.bool_]
    suspect: NDArray[np.bool_]
    shared: NDArray[np.bool_]
    found_px: Array
    amplitude: NDArray[np.floating]
    original_index: NDArray[np.intp] | None = None

    @classmethod
    def of(
        cls,
        position_px: Array,
        sigma_px: Array,
        flags: NDArray[np.int32] | None = None,
        policy: FlagPolicy = STANDARD_POLICY,
    ) -> "Measurements":
        """Check the peaks of an exposure and weigh their flags.

        A peak whose standard deviation is infinite or NaN is not used.

        Args:
            position_px: shape (S, K); NaN where there is no peak [px].
            sigma_px: standard deviations, shape (S, K) [px].
            flags: PeakFlag values, shape (S, K); None: no peak has one.
            policy: what the flags mean.

        Raises:
            InvalidParameter: other shapes, or a peak's standard deviation is not positive.
        """
        position = np.asarray(position_px, dtype=np.float64)
        sigma = np.asarray(sigma_px, dtype=np.float64)
        marks = np.zeros(position.shape, np.int32) if flags is None else np.asarray(flags, np.int32)
        if position.ndim != 2:
            raise InvalidParameter(
                f"position_px has the shape {position.shape}; it must be (sensors, peaks)"
            )
        for name, value in (("sigma_px", sigma), ("peak flags", marks)):
            if value.shape != position.shape:
                raise InvalidParameter(
                    f"{name} has the shape {value.shape}; it must be {position.shape}"
                )
        bad = np.isfinite(position) & (sigma <= 0.0)
        if bad.any():
            sensor, peak = (int(index) for index in np.argwhere(bad)[0])
            raise InvalidParameter(
                f"sigma_px[{sensor}, {peak}] is {sigma[sensor, peak]}; it must be above 0"
            )
        return cls.weigh(position, sigma, marks, np.zeros(position.shape), policy)

    @classmethod
    def weigh(
        cls,
        position_px: Array,
        sigma_px: Array,
        flags: NDArray[np.int32],
        amplitude: NDArray[np.floating],
        policy: FlagPolicy,
    ) -> "Measurements":
        """Weigh the flags of peaks, all of shape (S, K) or (F, S, K), without checks.

        Args:
            position_px: NaN where there is no peak [px].
            sigma_px: standard deviations [px].
            flags: PeakFlag values; 0 where there is no peak.
            amplitude: maxima above the background [counts].
            policy: what the flags mean.
        """
        # Finite where both are.
        usable = np.isfinite(position_px + sigma_px)
        count = np.count_nonzero(usable)
        variance = np.square(sigma_px if count == usable.size else np.where(usable, sigma_px, 1.0))
        if not np.count_nonzero(flags):
            position = position_px
            if count + np.count_nonzero(np.isnan(position_px)) != usable.size:
                position = np.where(usable, position_px, np.nan)
            none = np.zeros(usable.shape, dtype=np.bool_)
            weighed = cls(position, variance, flags, usable, none, none, position_px, amplitude)
            # Known here: the cached property need not find it again.
            vars(weighed)["usable"] = usable
            return weighed
        by_flags = policy.lookup
        usable &= ~by_flags.refused[flags]
        variance *= by_flags.variance_factor[flags]
        variance += by_flags.added_variance_px2[flags]
        return cls(
            np.where(usable, position_px, np.nan),
            np.where(usable, variance, 1.0),
            flags,
            usable & by_flags.initiates[flags],
            usable & by_flags.suspect[flags],
            usable & by_flags.shared[flags],
            position_px,
            amplitude,
        )

    def __len__(self) -> int:
        """Return the number of sensors."""
        return int(self.position_px.shape[-2])

    def exposure(self, index: int | NDArray[np.intp]) -> "Measurements":
        """Return one of several exposures, or some of them."""
        return Measurements(*(getattr(self, name)[index] for name in _PEAK_FIELDS))

    @cached_property
    def usable(self) -> NDArray[np.bool_]:
        """Mask of the peaks that may be used, shape (S, K)."""
        return np.isfinite(self.position_px)

    @cached_property
    def sigma_px(self) -> Array:
        """Standard deviations, flags weighed, shape (S, K) [px]; NaN where nothing is usable."""
        sigma: Array = np.sqrt(self.variance_px2)
        sigma[np.isnan(self.position_px)] = np.nan
        return sigma

    def only(self, chosen: NDArray[np.bool_]) -> "Measurements":
        """Return the chosen peaks, shape (S, K), at their indices; the others as not usable."""
        if np.count_nonzero(chosen & self.usable) == np.count_nonzero(self.usable):
            return self
        return replace(
            self,
            position_px=np.where(chosen, self.position_px, np.nan),
            variance_px2=np.where(chosen, self.variance_px2, 1.0),
            can_initiate=self.can_initiate & chosen,
            suspect=self.suspect & chosen,
            shared=self.shared & chosen,
        )

    def sort(self) -> "Measurements":
        """Return the usable peaks of an exposure in ascending order, empty places last.

        Equal positions are ordered by their variances, then by their flags, so that the result does
        not depend on the order of the peaks. Columns without any usable peak are left out.
        """
        position, columns = self.position_px, max(int(self.count.max(initial=0)), 1)
        rows = np.arange(len(position))[:, None]
        order = position.argsort(axis=-1, kind="stable")
        ascending = position[rows, order]
        if (ascending[:, 1:] == ascending[:, :-1]).any():
            order = np.lexsort((self.flags, self.variance_px2, position), axis=-1)
        order = order[:, :columns]
        sorted_fields = {name: getattr(self, name)[rows, order] for name in _PEAK_FIELDS}
        return Measurements(**sorted_fields, original_index=order)

    @cached_property
    def count(self) -> NDArray[np.intp]:
        """Number of usable peaks of each sensor, shape (S,)."""
        count: NDArray[np.intp] = self.usable.sum(axis=-1)
        return count

    @cached_property
    def capacity(self) -> dict[int, int]:
        """Number of markers that may share a peak, by ``sensor * K + peak``, where above one."""
        return dict.fromkeys(np.flatnonzero(self.shared).tolist(), 2)

    def readings(self, choice: NDArray[np.intp]) -> tuple[Array, Array]:
        """Return positions and standard deviations of choices of peaks.

        Args:
            choice: index of each sensor's peak, -1: none, shape (N, S).

        Returns:
            Positions and standard deviations, each of shape (N, S) [px]; NaN where there is none.
        """
        sensor = np.arange(len(self))
        none = choice < 0
        readings = self.position_px[sensor, choice]
        sigma = self.sigma_px[sensor, choice]
        readings[none] = np.nan
        sigma[none] = np.nan
        return readings, sigma

    def unambiguous_readings(self) -> tuple[Array, Array]:
        """Return the readings of sensors with one usable peak, and their standard deviations.

        Returns:
            Two arrays of shape (S,) [px]; NaN for sensors with no peak or several.
        """
        reading, sigma = self.readings(self.single_peaks[None])
        return reading[0], sigma[0]

    @property
    def single_peaks(self) -> NDArray[np.intp]:
        """Index of the usable peak of each sensor that has only one; else -1, shape (S,)."""
        return np.where(self.count == 1, self.usable.argmax(axis=1), -1)

    def is_near(self, reading_px: Array, distance_px: float) -> NDArray[np.bool_]:
        """Return whether a usable peak lies near predicted readings.

        Args:
            reading_px: predicted readings, shape (T, S) [px].
            distance_px: how near it must be [px].

        Returns:
            Shape (T, S).
        """
        with np.errstate(invalid="ignore"):
            apart = np.abs(self.position_px - reading_px[..., None])
        return np.asarray((apart <= distance_px).any(axis=2))

    def log_density(self, min_per_px: float, min_extent_px: float = 0.0) -> Array:
        """Return the log density of each sensor's peaks, of all markers and false ones.

        The number of gaps over the extent of the peaks; ``min_per_px`` for fewer than three
        peaks and as the lower limit.

        Args:
            min_per_px: smallest density [1/px].
            min_extent_px: smallest extent [px].

        Returns:
            Shape (S,) [log 1/px].
        """
        density = np.full(len(self), min_per_px)
        many = np.flatnonzero(self.count >= 3)
        if len(many):
            position_px = self.position_px[many]
            extent = np.nanmax(position_px, axis=1) - np.nanmin(position_px, axis=1)
            with np.errstate(divide="ignore"):
                peak_density = (self.count[many] - 1) / np.maximum(extent, min_extent_px)
            density[many] = np.maximum(density[many], peak_density)
        log: Array = np.log(density)
        return log


_PEAK_FIELDS = tuple(field.name for field in fields(Measurements))[:-1]
"""Fields with a value for each peak."""


@dataclass(frozen=True, eq=False)
class MeasurementNoise:
    """Noise and model error of each sensor's readings under a calibration.

    Args:
        sensor_sigma_px: standard deviation of a reading without one of its own, shape (S,) [px].
        model_error_px: root of the residuals' variance in excess of the noise, shape (S,) [px].
        min_sigma_px: lower bound of a reading's standard deviation, shape (S,) [px].
    """

    sensor_sigma_px: Array
    model_error_px: Array
    min_sigma_px: Array

    def sigma(self, sigma_px: Array) -> Array:
        """Return the readings' standard deviations for reconstruction, shape (..., S) [px].

        Args:
            sigma_px: the readings' own, shape (..., S) [px]; NaN: the calibration's is used.
        """
        noise = np.where(np.isnan(sigma_px), self.sensor_sigma_px, sigma_px)
        total: Array = np.maximum(np.hypot(noise, self.model_error_px), self.min_sigma_px)
        return total


def check_sensors(measurements: Measurements, sensors: int) -> None:
    """Refuse measurements of another number of sensors, or of several exposures.

    Args:
        measurements: of one exposure.
        sensors: how many there must be.

    Raises:
        InvalidParameter: the measurements have another shape.
    """
    shape = measurements.position_px.shape
    if len(shape) != 2 or shape[0] != sensors:
        raise InvalidParameter(f"position_px has the shape {shape}; it must be ({sensors}, K)")
