"""Names of flags, as clients see them."""

from enum import IntFlag
from functools import lru_cache


# By type too: flags of different kinds with the same value are equal.
@lru_cache(maxsize=None, typed=True)
def flag_names(flags: IntFlag) -> tuple[str, ...]:
    """Return the flags that hold, in lower case with hyphens: ``too-few-sensors``, ..."""
    return tuple(str(flag.name).lower().replace("_", "-") for flag in flags)
