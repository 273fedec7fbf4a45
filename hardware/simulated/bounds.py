"""Bounds of settings, written once at the field and checked in Python as at the edge."""

from collections.abc import Iterator
from functools import cache
from types import NoneType
from typing import Annotated, Any, get_args, get_origin, get_type_hints

from compute.errors import InvalidParameter

_COMPARISONS = (
    ("gt", "more than", lambda value, bound: value > bound),
    ("ge", "at least", lambda value, bound: value >= bound),
    ("lt", "less than", lambda value, bound: value < bound),
    ("le", "at most", lambda value, bound: value <= bound),
    ("min_length", "of length at least", lambda value, bound: len(value) >= bound),
    ("max_length", "of length at most", lambda value, bound: len(value) <= bound),
)


def check_bounds(settings: object) -> None:
    """Check every field of a dataclass against the bounds in its annotation.

    A field is annotated as ``Annotated[float, Field(gt=0, le=10)]``, which pydantic reads as
    well; tuples are checked item by item; None passes where the annotation allows it.

    Raises:
        InvalidParameter: a value is out of bounds, or NaN where there are bounds.
    """
    for name, hint in _hints(type(settings)).items():
        value = getattr(settings, name)
        bounds = dict(_violations(value, hint))
        if bounds:
            offending, right = next(iter(bounds.items()))
            raise InvalidParameter(f"{name} is {offending}; it must be {right}", **{name: value})


@cache
def _hints(settings: type) -> dict[str, Any]:
    return get_type_hints(settings, include_extras=True)


def _violations(value: Any, hint: Any) -> Iterator[tuple[str, str]]:
    """Yield what is out of bounds, and what would be right."""
    if get_origin(hint) is Annotated:
        base, *metadata = get_args(hint)
        bounds = [bound for entry in metadata for bound in getattr(entry, "metadata", ())]
        rules = [
            (f"{words} {getattr(bound, kind)}", holds(value, getattr(bound, kind)))
            for kind, words, holds in _COMPARISONS
            for bound in bounds
            if hasattr(bound, kind)
        ]
        if not all(holds for _, holds in rules):
            yield str(value), " and ".join(words for words, _ in rules)
        yield from _violations(value, base)
    elif get_origin(hint) is tuple:
        items = get_args(hint)
        of_each = [items[0]] * len(value) if items[1:] == (Ellipsis,) else list(items)
        if len(of_each) != len(value):
            yield str(value), f"{len(of_each)} numbers"
        for item, item_hint in zip(value, of_each, strict=False):
            yield from _violations(item, item_hint)
    elif value is not None and NoneType in get_args(hint):
        for arm in get_args(hint):
            yield from _violations(value, arm)
