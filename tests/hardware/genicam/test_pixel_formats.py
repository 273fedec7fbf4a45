"""Pixel formats: unpacking inverts the packing of the standards."""

from typing import get_args

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from compute.errors import InvalidParameter
from hardware.genicam.pixel_formats import PixelFormat, bits_per_pixel, check_width, unpack_counts

WIDTH = 8


def packed(counts: list[int], pixel_format: str) -> bytes:
    """Pack counts as the standards describe it, with whole numbers and strings of bits."""
    bits = bits_per_pixel(pixel_format)  # type: ignore[arg-type]
    if pixel_format.endswith("p"):  # one row of bits, the lowest first
        row = "".join(f"{count:0{bits}b}"[::-1] for count in counts)
        return bytes(int(row[i : i + 8][::-1], 2) for i in range(0, len(row), 8))
    if pixel_format.endswith("Packed"):
        low = bits - 8
        data = bytearray()
        for first, second in zip(counts[::2], counts[1::2], strict=True):
            mask = (1 << low) - 1
            data += bytes([first >> low, (second & mask) << 4 | first & mask, second >> low])
        return bytes(data)
    return b"".join(count.to_bytes(1 if bits == 8 else 2, "little") for count in counts)


@pytest.mark.parametrize("pixel_format", get_args(PixelFormat))
@settings(deadline=None, max_examples=40)
@given(data=st.data())
def test_packed_counts_come_back(pixel_format: PixelFormat, data: st.DataObject) -> None:
    height = data.draw(st.integers(1, 3))
    largest = 2 ** bits_per_pixel(pixel_format) - 1
    one = st.integers(0, largest)
    counts = data.draw(st.lists(one, min_size=WIDTH * height, max_size=WIDTH * height))
    raw = packed(counts, pixel_format) + data.draw(st.binary(max_size=5))
    lines = unpack_counts(raw, pixel_format, WIDTH, height)
    assert lines is not None
    assert lines.dtype == np.uint16
    np.testing.assert_array_equal(lines, np.array(counts).reshape(height, WIDTH))


@pytest.mark.parametrize("pixel_format", get_args(PixelFormat))
def test_too_few_bytes_are_no_lines(pixel_format: PixelFormat) -> None:
    raw = packed([1] * WIDTH, pixel_format)
    assert unpack_counts(raw, pixel_format, WIDTH, 1) is not None
    assert unpack_counts(raw[:-1], pixel_format, WIDTH, 1) is None


def test_known_bytes() -> None:
    """0x123 and 0x456: the example of each standard's layout."""
    twelve = unpack_counts(bytes([0x23, 0x61, 0x45]), "Mono12p", 2, 1)
    packed_12 = unpack_counts(bytes([0x12, 0x63, 0x45]), "Mono12Packed", 2, 1)
    ten = unpack_counts(bytes([0b0000_0001, 0b0000_1000, 0b0011_0000, 0, 0b1]), "Mono10p", 4, 1)
    assert twelve is not None
    assert packed_12 is not None
    assert ten is not None
    assert twelve.tolist() == packed_12.tolist() == [[0x123, 0x456]]
    assert ten.tolist() == [[1, 2, 3, 0b1 << 2]]


@pytest.mark.parametrize(
    ("pixel_format", "width"), [("Mono12p", 7), ("Mono10p", 6), ("Mono12Packed", 9)]
)
def test_a_line_that_ends_in_a_byte_is_refused(pixel_format: PixelFormat, width: int) -> None:
    with pytest.raises(InvalidParameter, match=f"a line of {width} pixels in {pixel_format}"):
        check_width(pixel_format, width)
    check_width("Mono8", width)
