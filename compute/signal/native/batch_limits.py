"""Limits of batches: number of scans, pixels, memory."""

from typing import Final

from compute.errors import InvalidParameter
from compute.signal.centroid_settings import MAX_PIXELS, MIN_PIXELS


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


MAX_VALUES: Final = 2**31 - 1
"""Values of one of Warp's arrays."""


def check_room(lines: int, pixels: int, record_words: int, *, copied: bool) -> None:
    """Refuse batches whose records, or pixels where these are copied, no array has room for.

    Args:
        lines: most lines of one call.
        pixels: of each.
        record_words: 64-bit words of a line's record.
        copied: the lines are brought to the device.

    Raises:
        InvalidParameter: there are more.
    """
    each = max(record_words, pixels if copied else 0)
    if lines * each > MAX_VALUES:
        raise InvalidParameter(
            f"lines is {lines}, of {pixels} pixels each; this device takes {MAX_VALUES // each} "
            "such lines at once: find their peaks in several batches",
            lines=lines,
        )
