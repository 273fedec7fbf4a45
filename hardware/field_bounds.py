"""Checks settings against the bounds in their pydantic field annotations."""

from collections.abc import Callable, Iterator
from types import NoneType
from typing import Annotated, Any, get_args, get_origin, get_type_hints

from compute.errors import InvalidParameter

_COMPARISONS: tuple[tuple[str, str, Callable[[Any, Any], bool]], ...] = (
    ("gt", "more than", lambda value, bound: value > bound),
    ("ge", "at least", lambda value, bound: value >= bound),
    ("lt", "less than", lambda value, bound: value < bound),
    ("le", "at most", lambda value, bound: value <= bound),
    ("min_length", "of length at least", lambda value, bound: len(value) >= bound),
    ("max_length", "of length at most", lambda value, bound: len(value) <= bound),
)


def check_field_bounds(settings: Any) -> None:
    """Check every field of a dataclass against the bounds in its annotation.

    A field is annotated as ``Annotated[float, Field(gt=0, le=10)]``, which pydantic reads as
    well; tuples are checked item by item; None passes where the annotation allows it.

    Raises:
        InvalidParameter: a value is out of bounds, or NaN where there are bounds.
    """
    for name, hint in get_type_hints(type(settings), include_extras=True).items():
        value = getattr(settings, name)
        for offending, right in _violations(value, hint):
            raise InvalidParameter(f"{name} is {offending}; it must be {right}", **{name: value})


def _violations(value: Any, hint: Any) -> Iterator[tuple[str, str]]:
    """Yield each offending value with a description of what is allowed."""
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
    elif hint is int and not isinstance(value, int):
        yield str(value), "a whole number"
    elif get_origin(hint) is tuple:
        items = get_args(hint)
        of_each = [items[0]] * len(value) if items[1:] == (Ellipsis,) else list(items)
        if len(of_each) != len(value):
            yield str(value), f"of length {len(of_each)}"
        for item, item_hint in zip(value, of_each, strict=False):
            yield from _violations(item, item_hint)
    elif value is not None and NoneType in get_args(hint):
        for arm in get_args(hint):
            yield from _violations(value, arm)
