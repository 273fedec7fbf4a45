"""The version of the installed distribution."""

from importlib.metadata import PackageNotFoundError, version


def package_version() -> str:
    """Return the installed distribution's version, "0+source" when it is not installed."""
    try:
        return version("lumiline")
    except PackageNotFoundError:
        return "0+source"
