"""Range checks of parameters: a value out of range raises InvalidParameter."""

from math import inf
from typing import Any

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter


def require(holds: bool | np.bool_, right: str, **parameter: object) -> None:
    """Raise "NAME is VALUE; it must RIGHT" unless a condition holds.

    Args:
        holds: the condition.
        right: the valid range, as "be positive".
        parameter: one parameter, by its name.

    Raises:
        InvalidParameter: the condition does not hold.
    """
    if not holds:
        ((name, value),) = parameter.items()
        text = repr(value) if isinstance(value, str) else value
        raise InvalidParameter(f"{name} is {text}; it must {right}", **parameter)


def require_shape(holds: bool, right: str, **array: NDArray[Any]) -> None:
    """Raise "NAME has the shape SHAPE; it must RIGHT" unless a condition holds.

    Args:
        holds: the condition.
        right: the valid shape, as "be (N, 3)".
        array: one array, by its name.

    Raises:
        InvalidParameter: the condition does not hold.
    """
    if not holds:
        ((name, value),) = array.items()
        raise InvalidParameter(
            f"{name} has the shape {value.shape}; it must {right}", **{name: value.shape}
        )


def check_positive(holder: object, *names: str) -> None:
    """Raise InvalidParameter for the first field that is not positive and finite."""
    for name in names:
        value = getattr(holder, name)
        require(0.0 < value < inf, "be positive", **{name: value})


def check_not_negative(holder: object, *names: str) -> None:
    """Raise InvalidParameter for the first field that is negative or not finite."""
    for name in names:
        value = getattr(holder, name)
        require(0.0 <= value < inf, "be zero or positive", **{name: value})


def check_finite(holder: object, *names: str) -> None:
    """Raise InvalidParameter for the first field with a value that is not finite."""
    for name in names:
        value = getattr(holder, name)
        require(np.isfinite(value).all(), "be finite", **{name: value})
