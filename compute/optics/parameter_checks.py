"""Range checks of parameters: positive, not negative."""

from math import inf

from compute.errors import InvalidParameter


def check_positive(holder: object, *names: str) -> None:
    """Refuse fields that are not positive and finite.

    Raises:
        InvalidParameter: with the first such field.
    """
    for name in names:
        value = getattr(holder, name)
        if not 0.0 < value < inf:
            raise InvalidParameter(f"{name} is {value}; it must be positive", **{name: value})


def check_not_negative(holder: object, *names: str) -> None:
    """Refuse fields that are negative or not finite.

    Raises:
        InvalidParameter: with the first such field.
    """
    for name in names:
        value = getattr(holder, name)
        if not 0.0 <= value < inf:
            raise InvalidParameter(
                f"{name} is {value}; it must be zero or positive", **{name: value}
            )
