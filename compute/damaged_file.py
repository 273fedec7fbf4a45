"""Reading of files that may be damaged: a library's exceptions become one error with a reason."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from compute.errors import LumilineError


@contextmanager
def refusing_damage(invalid: Callable[[str], LumilineError]) -> Iterator[None]:
    """Raise what ``invalid`` makes of the reason for any exception that is not the domain's own.

    A library that reads a damaged file raises what the damage happens to cause: h5py's authors
    name no set of exceptions, and flipped bits have brought eight kinds so far.

    Args:
        invalid: makes the error from the library's reason, one line of text.

    Raises:
        LumilineError: what ``invalid`` made, or the domain's own error.
        MemoryError: there is not enough memory for the file.
    """
    try:
        yield
    except (LumilineError, MemoryError):
        raise
    except Exception as error:
        lines = str(error).strip().splitlines()
        raise invalid(lines[0][:200] if lines else type(error).__name__) from error
