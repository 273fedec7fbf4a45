"""Base of settings: values are checked against the constraints in their pydantic annotations."""

import re
from collections.abc import Callable, Iterable, Iterator
from types import NoneType
from typing import Annotated, Any, ClassVar, Final, Literal, get_args, get_origin, get_type_hints

from pydantic import ConfigDict, FailFast, StringConstraints

from compute.errors import InvalidParameter

SensorName = Annotated[str, StringConstraints(pattern=r"^[^\s\u0085](.{0,62}[^\s\u0085])?$")]


class _FailFast(FailFast):
    def __hash__(self) -> int:  # unions of annotated types need one
        return hash(self.fail_fast)


FIRST_ERROR_ONLY: Final = _FailFast()
"""Annotation of a list: validation stops at the first wrong item.

Lists come from clients of the service, too, and a message for each of thousands of wrong items
would take seconds.
"""

_CONSTRAINTS: Final[tuple[tuple[str, str, Callable[[Any, Any], bool]], ...]] = (
    ("gt", "more than {}", lambda value, bound: value > bound),
    ("ge", "at least {}", lambda value, bound: value >= bound),
    ("lt", "less than {}", lambda value, bound: value < bound),
    ("le", "at most {}", lambda value, bound: value <= bound),
    ("min_length", "of length at least {}", lambda value, bound: len(value) >= bound),
    ("max_length", "of length at most {}", lambda value, bound: len(value) <= bound),
    ("pattern", "text of the form {}", lambda value, bound: bool(re.fullmatch(bound, value))),
)


class CheckedSettings:
    """Base of settings dataclasses: pydantic refuses unknown fields, and values are checked.

    A field is annotated as ``Annotated[float, Field(gt=0, le=10)]`` or ``Literal[...]``, which
    pydantic reads as well; tuples are checked item by item; None passes where it is allowed.

    Raises:
        InvalidParameter: a value is out of bounds, or NaN where there are bounds.
    """

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(extra="forbid")

    def __post_init__(self) -> None:
        for name, hint in get_type_hints(type(self), include_extras=True).items():
            value = getattr(self, name)
            for invalid, right in _violations(value, hint):
                raise InvalidParameter(f"{name} is {invalid}; it must be {right}", **{name: value})


def check_distinct(items: Iterable[object], noun: str, *names: str) -> None:
    """Raise InvalidParameter where two items have the same value of a field."""
    for name in names:
        values = [getattr(item, name) for item in items]
        repeated = next((value for value in values if values.count(value) > 1), None)
        if repeated is not None:
            raise InvalidParameter(
                f'"{repeated}" is given as the {name} of two {noun}; give each one of its own',
                **{name: repeated},
            )


def _violations(value: Any, hint: Any) -> Iterator[tuple[str, str]]:
    """Yield each invalid value with a description of what is allowed."""
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Annotated:
        base, *metadata = arguments
        rules = [
            (text.format(bound), holds(value, bound))
            for entry in metadata
            for constraint in (entry, *getattr(entry, "metadata", ()))
            for kind, text, holds in _CONSTRAINTS
            if (bound := getattr(constraint, kind, None)) is not None
        ]
        if not all(holds for _, holds in rules):
            yield _format(value), " and ".join(text for text, _ in rules)
        yield from _violations(value, base)
    elif origin is Literal:
        if value not in arguments:
            yield _format(value), f"one of {', '.join(arguments)}"
    elif hint is int and not isinstance(value, int):
        yield _format(value), "a whole number"
    elif origin is tuple:
        of_each = [arguments[0]] * len(value) if arguments[1:] == (Ellipsis,) else list(arguments)
        if len(of_each) != len(value):
            yield _format(value), f"of length {len(of_each)}"
        for item, item_hint in zip(value, of_each, strict=False):
            yield from _violations(item, item_hint)
    elif value is not None and NoneType in arguments:
        for arm in arguments:
            yield from _violations(value, arm)


def _format(value: Any) -> str:
    return f"{value!r:.100}" if isinstance(value, str) else f"{value!s:.100}"
