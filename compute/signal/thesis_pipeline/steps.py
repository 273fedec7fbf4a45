"""Interfaces of the steps of a chain: filter and background."""

from abc import ABC, abstractmethod
from typing import Final, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from compute.errors import InvalidParameter, NonFiniteValue
from compute.signal.centroid_settings import MAX_PIXELS

Array = NDArray[np.float64]

Compensation = Literal["none", "delay", "phase"]
"""What is done about a filter's delay: nothing; positions are moved back by the delay at zero
frequency; or the filter's phase is removed, so that there is no delay."""

MAX_TAPS: Final = 1024
"""Longest aperture or impulse response of a filter [px]."""
_MIN_PIXELS: Final = 8


class ScanFilter(ABC):
    """A filter along scans."""

    compensation: Compensation

    @property
    @abstractmethod
    def delay_px(self) -> float:
        """Delay at zero frequency, if the phase is not removed [px]."""

    @property
    def shift_px(self) -> float:
        """Shift of the filtered scan to the right of the light [px]."""
        return 0.0 if self.compensation == "phase" else self.delay_px

    @property
    def correction_px(self) -> float:
        """Delay that the chain subtracts from positions [px]; zero where it is not compensated."""
        return self.delay_px if self.compensation == "delay" else 0.0

    @property
    def reach_px(self) -> float:
        """Distance from an end within which pixels beyond it matter [px]."""
        return self.delay_px

    @abstractmethod
    def apply(self, scans: ArrayLike) -> Array:
        """Filter scans (..., P)."""

    @abstractmethod
    def adjoint(self, weights: Array) -> Array:
        """Carry derivatives by filtered pixels (..., P) back to derivatives by pixels."""


class Background(ABC):
    """An estimate of the light that does not come from markers."""

    def estimate(self, scans: ArrayLike) -> tuple[Array, NDArray[np.bool_]]:
        """Return the background of scans (..., P), and the mask of pixels it was estimated from."""
        values = as_scans(scans)
        background, free = np.empty_like(values), np.empty(values.shape, dtype=np.bool_)
        for row in np.ndindex(values.shape[:-1]):
            background[row], free[row] = self.estimate_scan(values[row])
        return background, free

    @abstractmethod
    def estimate_scan(self, scan: Array) -> tuple[Array, NDArray[np.bool_]]:
        """Return the background of one scan (P,), and the mask of pixels it was estimated from."""

    @abstractmethod
    def adjoint(self, weights: Array, background_mask: NDArray[np.bool_]) -> Array:
        """Carry derivatives by a scan less its background back to its pixels, shape (..., P).

        Which pixels the background was taken from is taken as given.

        Args:
            weights: derivatives by the scan less its background, shape (..., P).
            background_mask: pixels that the background was taken from, shape (P,).
        """


def as_scans(scans: ArrayLike) -> Array:
    """Return scans as float64, shape (..., P).

    Raises:
        InvalidParameter: scans of fewer than 8 or more than 65536 pixels.
        NonFiniteValue: a value is NaN or infinite.
    """
    values = np.asarray(scans, dtype=np.float64)
    pixels = values.shape[-1] if values.ndim else 0
    if not _MIN_PIXELS <= pixels <= MAX_PIXELS:
        raise InvalidParameter(
            f"scans have {pixels} pixels; they must have {_MIN_PIXELS} to {MAX_PIXELS}",
            pixels=pixels,
        )
    if not np.isfinite(values).all():
        bad = float(values[~np.isfinite(values)][0])
        raise NonFiniteValue(f"scans have the value {bad}; all must be finite", value=bad)
    return values
