"""Unpacks GenICam pixel formats: a buffer's bytes to counts."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter

PixelFormat = Literal[
    "Mono8",
    "Mono10",
    "Mono12",
    "Mono14",
    "Mono16",
    "Mono10p",
    "Mono12p",
    "Mono10Packed",
    "Mono12Packed",
]
"""Names of the pixel format naming convention (PFNC), and GigE Vision's older ``...Packed``."""

Bytes = NDArray[np.uint8]
Counts = NDArray[np.uint16]


def _bytes(data: Bytes) -> Counts:
    return data.astype(np.uint16)


def _words(data: Bytes) -> Counts:
    return data.view(np.dtype("<u2")).astype(np.uint16)


def _mono10p(data: Bytes) -> Counts:
    """4 pixels in 5 bytes, the lowest bits first."""
    group = data.reshape(-1, 5).astype(np.uint16)
    pixels = np.empty((len(group), 4), np.uint16)
    for i in range(4):
        pixels[:, i] = (group[:, i] >> (2 * i)) | (group[:, i + 1] << (8 - 2 * i)) & 0x3FF
    return pixels.reshape(-1)


def _mono12p(data: Bytes) -> Counts:
    """2 pixels in 3 bytes, the lowest bits first."""
    low, middle, high = data.reshape(-1, 3).astype(np.uint16).T
    return np.stack([low | (middle & 0xF) << 8, middle >> 4 | high << 4], axis=1).reshape(-1)


def _mono10packed(data: Bytes) -> Counts:
    """2 pixels in 3 bytes: the high bits of one, the low bits of both, the other's high bits."""
    first, low, second = data.reshape(-1, 3).astype(np.uint16).T
    return np.stack([first << 2 | low & 3, second << 2 | low >> 4 & 3], axis=1).reshape(-1)


def _mono12packed(data: Bytes) -> Counts:
    """2 pixels in 3 bytes: the high 8 bits of one, the low 4 of both, the other's high 8."""
    first, low, second = data.reshape(-1, 3).astype(np.uint16).T
    return np.stack([first << 4 | low & 0xF, second << 4 | low >> 4], axis=1).reshape(-1)


@dataclass(frozen=True)
class _Layout:
    bits: int
    pixels: int
    bytes: int
    unpack: Callable[[Bytes], Counts]


_LAYOUTS: Final[dict[PixelFormat, _Layout]] = {
    "Mono8": _Layout(8, 1, 1, _bytes),
    "Mono10": _Layout(10, 1, 2, _words),
    "Mono12": _Layout(12, 1, 2, _words),
    "Mono14": _Layout(14, 1, 2, _words),
    "Mono16": _Layout(16, 1, 2, _words),
    "Mono10p": _Layout(10, 4, 5, _mono10p),
    "Mono12p": _Layout(12, 2, 3, _mono12p),
    "Mono10Packed": _Layout(10, 2, 3, _mono10packed),
    "Mono12Packed": _Layout(12, 2, 3, _mono12packed),
}
assert set(_LAYOUTS) == set(get_args(PixelFormat))


def bits_per_pixel(pixel_format: PixelFormat) -> int:
    """Return the resolution of a pixel format [bits]."""
    return _LAYOUTS[pixel_format].bits


def check_width(pixel_format: PixelFormat, width: int) -> None:
    """Check that scans of this width end at a byte boundary.

    Raises:
        InvalidParameter: they do not.
    """
    group = _LAYOUTS[pixel_format].pixels
    if width % group:
        raise InvalidParameter(
            f"a line of {width} pixels in {pixel_format} does not end at a byte; the width must be "
            f"a multiple of {group}",
            width=width,
        )


def unpack_counts(data: bytes, pixel_format: PixelFormat, width: int, height: int) -> Counts | None:
    """Return the counts of a buffer.

    Args:
        data: the buffer's bytes.
        pixel_format: how they hold the pixels.
        width: pixels of a line, see ``check_width``.
        height: lines.

    Returns:
        uint16, shape (height, width); None when the bytes are too few. Surplus ones (padding,
        chunks) are left out.
    """
    layout = _LAYOUTS[pixel_format]
    size = width * height // layout.pixels * layout.bytes
    if len(data) < size:
        return None
    return layout.unpack(np.frombuffer(data, np.uint8, size)).reshape(height, width)
