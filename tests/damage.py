"""Damages files as disks, cables and people do: flipped bits, overwritten bytes, a missing end."""

import os
from collections.abc import Iterator

import numpy as np
import pytest

A_FEW = 40
MANY = 1000

FEW_OR_MANY = pytest.mark.parametrize("count", [A_FEW, pytest.param(MANY, marks=pytest.mark.slow)])


def damages(
    whole: bytes, count: int, *, overwritten: int = 16, head: int | None = None
) -> Iterator[bytes]:
    """Yield damaged copies; the first few are the same in each run, many are new ones.

    Args:
        whole: the file.
        count: how many; one that comes out as the whole is left out.
        overwritten: most bytes that are overwritten at a place.
        head: half of the places are within so many first bytes, where formats have their headers.
    """
    first = 0 if count < MANY else int.from_bytes(os.urandom(3))
    for seed in range(first, first + count):
        found = _damaged(whole, np.random.default_rng([23, seed]), overwritten, head)
        if found != whole:
            yield found


def _damaged(
    whole: bytes, random: np.random.Generator, overwritten: int, head: int | None
) -> bytes:
    """Flip one bit or eight, overwrite bytes, or cut the end off."""
    kind = random.integers(4)
    if kind == 3:
        return whole[: random.integers(len(whole))]
    data = bytearray(whole)
    in_head = head is not None and random.random() < 0.5
    place = int(random.integers(min(head or 0, len(data)) if in_head else len(data)))
    if kind == 2:
        data[place : place + overwritten] = random.bytes(len(data[place : place + overwritten]))
    else:
        for at in place + random.integers(0, 16, 1 + 7 * kind):
            data[min(int(at), len(data) - 1)] ^= 1 << random.integers(8)
    return bytes(data)
