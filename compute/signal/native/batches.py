"""What a batch of lines may be."""

from compute.errors import InvalidParameter
from compute.signal.settings import MAX_PIXELS, MIN_PIXELS


def check_size(lines: int, pixels: int) -> None:
    """Refuse batches that no kernel takes.

    Raises:
        InvalidParameter: fewer than one line, or lines that are too short or too long.
    """
    if lines < 1:
        raise InvalidParameter(f"lines is {lines}; it must be 1 or more", lines=lines)
    if not MIN_PIXELS <= pixels <= MAX_PIXELS:
        raise InvalidParameter(
            f"a line has {pixels} pixels; it must have {MIN_PIXELS} to {MAX_PIXELS}",
            pixels=pixels,
        )
