"""Interfaces of the steps of a chain (filter, background), and checks of their settings."""

from math import isfinite
from typing import Final, Literal, Protocol, get_args

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


class ScanFilter(Protocol):
    """A filter along scans."""

    @property
    def shift_px(self) -> float:
        """Shift of the filtered scan to the right of the light [px]."""
        ...

    @property
    def correction_px(self) -> float:
        """What the chain subtracts from positions [px]: the shift, or zero if it is to stay."""
        ...

    @property
    def reach_px(self) -> float:
        """Distance from an end within which pixels beyond it matter [px]."""
        ...

    def apply(self, scans: ArrayLike) -> Array:
        """Filter scans (..., P)."""
        ...

    def adjoint(self, weights: Array) -> Array:
        """Carry derivatives by filtered pixels (..., P) back to derivatives by pixels."""
        ...


class Background(Protocol):
    """An estimate of the light that does not come from markers."""

    def estimate(self, scans: ArrayLike) -> tuple[Array, NDArray[np.bool_]]:
        """Return the background of scans (..., P), and which pixels it was taken from."""
        ...

    def adjoint(self, weights: Array, background_mask: NDArray[np.bool_]) -> Array:
        """Carry derivatives by a scan less its background back to its pixels, shape (..., P).

        Args:
            weights: derivatives by the scan less its background, shape (..., P).
            background_mask: pixels that the background was taken from, same shape.
        """
        ...


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
            f"lines have {pixels} pixels; they must have {_MIN_PIXELS} to {MAX_PIXELS}",
            pixels=pixels,
        )
    if not np.isfinite(values).all():
        bad = float(values[~np.isfinite(values)][0])
        raise NonFiniteValue(f"lines have the value {bad}; all must be finite", value=bad)
    return values


def check_whole(name: str, value: int, minimum: int, maximum: int) -> None:
    """Refuse a number that is not whole or lies outside its range.

    Args:
        name: name of the value, for the message.
        value: the number.
        minimum: least value that is allowed.
        maximum: greatest value that is allowed.

    Raises:
        InvalidParameter: with the value and the range.
    """
    if isinstance(value, bool) or int(value) != value or not minimum <= value <= maximum:
        raise InvalidParameter(
            f"{name} is {value}; it must be a whole number in {minimum} .. {maximum}",
            **{name: value},
        )


def check_between(name: str, value: float, minimum: float, maximum: float) -> None:
    """Refuse a number outside its range; the ends belong to it.

    Args:
        name: name of the value, for the message.
        value: the number.
        minimum: least value that is allowed.
        maximum: greatest value that is allowed.

    Raises:
        InvalidParameter: with the value and the range.
    """
    if not (isfinite(value) and minimum <= value <= maximum):
        raise InvalidParameter(
            f"{name} is {value}; it must lie in {minimum:g} .. {maximum:g}", **{name: value}
        )


def check_cutoff(cutoff: float) -> None:
    """Refuse a cut-off that is not a fraction of half the sampling rate.

    Raises:
        InvalidParameter: with the value.
    """
    if not 0.0 < cutoff < 1.0:
        raise InvalidParameter(
            f"cutoff is {cutoff}; it must lie between 0 and 1, as a fraction of half the "
            "sampling rate",
            cutoff=cutoff,
        )


def check_compensation(
    value: Compensation, allowed: tuple[Compensation, ...] | None = None
) -> None:
    """Refuse an unknown compensation.

    Args:
        value: the compensation.
        allowed: the known ones; None: all.

    Raises:
        InvalidParameter: with the value and those that there are.
    """
    known = get_args(Compensation) if allowed is None else allowed
    if value not in known:
        raise InvalidParameter(
            f"compensation is {value!r}; it must be one of {known}", compensation=value
        )
