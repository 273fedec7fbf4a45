"""The binary-reflected Gray code: neighbouring numbers differ in one bit."""

import numpy as np
from numpy.typing import NDArray

Integers = NDArray[np.int64]


def gray_encode(numbers: Integers) -> Integers:
    """Return the Gray codes of numbers that are zero or positive, same shape."""
    return numbers ^ (numbers >> 1)


def gray_decode(codes: Integers) -> Integers:
    """Return the numbers that Gray codes stand for, same shape; inverse of ``gray_encode``."""
    numbers = codes.copy()
    shift = 1
    while shift < 64:
        numbers ^= numbers >> shift
        shift *= 2
    return numbers


def to_bits(numbers: Integers, bits: int) -> NDArray[np.bool_]:
    """Return the bits of numbers, the highest first, shape (..., bits)."""
    set_bits: NDArray[np.bool_] = (numbers[..., None] >> np.arange(bits - 1, -1, -1)) & 1 == 1
    return set_bits


def from_bits(bits: NDArray[np.bool_]) -> Integers:
    """Return the numbers of bits (..., bits), the highest first; inverse of ``to_bits``."""
    weights = np.int64(1) << np.arange(bits.shape[-1] - 1, -1, -1)
    numbers: Integers = (bits * weights).sum(axis=-1)
    return numbers
