"""Libraries of the extra `export`, imported when an export needs them."""

from importlib import import_module
from typing import Any

from hardware.errors import MissingLibrary


def import_optional(name: str) -> Any:
    """Return a module; raises MissingLibrary."""
    try:
        return import_module(name)
    except ImportError as error:
        library = name.partition(".")[0]
        raise MissingLibrary(
            f"the library {library} is not installed ({error}); it comes with the extra "
            "'export': pip install 'lumiline[export]'",
            library=library,
        ) from error
