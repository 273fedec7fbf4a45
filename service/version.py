"""The version of the installed distribution, and what it may be used for."""

from functools import cache
from importlib.metadata import PackageNotFoundError, version
from typing import Final

DISCLAIMER: Final = "For research use only. Not a medical device: see DISCLAIMER.md."


@cache
def package_version() -> str:
    """Return the installed distribution's version, "0+source" when it is not installed."""
    try:
        return version("lumiline")
    except PackageNotFoundError:
        return "0+source"
