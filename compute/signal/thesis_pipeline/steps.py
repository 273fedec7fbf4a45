"""ScanFilter and Background: what a step of the chain must do, and checks of lines and settings."""

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

_LEAST_PIXELS: Final = 8


class ScanFilter(Protocol):
    """A filter along lines."""

    @property
    def shift_px(self) -> float:
        """By how much the filtered line lies to the right of the light [px]."""
        ...

    @property
    def correction_px(self) -> float:
        """What the chain subtracts from positions [px]: the shift, or zero if it is to stay."""
        ...

    @property
    def reach_px(self) -> float:
        """How near to an end the light must be for what lies beyond the line to weigh in [px]."""
        ...

    def apply(self, lines: ArrayLike) -> Array:
        """Filter lines (..., P)."""
        ...

    def adjoint(self, weights: Array) -> Array:
        """Carry derivatives by filtered pixels (..., P) back to derivatives by pixels."""
        ...


class Background(Protocol):
    """An estimate of the light that does not come from markers."""

    def estimate(self, lines: ArrayLike) -> tuple[Array, NDArray[np.bool_]]:
        """Return the background of lines (..., P), and which pixels it was taken from."""
        ...

    def adjoint(self, weights: Array, background_mask: NDArray[np.bool_]) -> Array:
        """Carry derivatives by a line less its background back to its pixels, shape (..., P)."""
        ...


def as_lines(lines: ArrayLike) -> Array:
    """Return lines as float64, shape (..., P).

    Raises:
        InvalidParameter: lines of fewer than 8 or more than 65536 pixels.
        NonFiniteValue: a value is NaN or infinite.
    """
    values = np.asarray(lines, dtype=np.float64)
    pixels = values.shape[-1] if values.ndim else 0
    if not _LEAST_PIXELS <= pixels <= MAX_PIXELS:
        raise InvalidParameter(
            f"lines have {pixels} pixels; they must have {_LEAST_PIXELS} to {MAX_PIXELS}",
            pixels=pixels,
        )
    if not np.isfinite(values).all():
        bad = float(values[~np.isfinite(values)][0])
        raise NonFiniteValue(f"lines have the value {bad}; all must be finite", value=bad)
    return values


def check_whole(name: str, value: int, minimum: int, maximum: int) -> None:
    """Refuse a number that is not whole or lies outside its range.

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
    """Refuse a compensation that there is not.

    Raises:
        InvalidParameter: with the value and those that there are.
    """
    known = get_args(Compensation) if allowed is None else allowed
    if value not in known:
        raise InvalidParameter(
            f"compensation is {value!r}; it must be one of {known}", compensation=value
        )
