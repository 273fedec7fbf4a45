"""Damages files as disks, cables and people do: flipped bits, overwritten bytes, a missing end."""

import os
from collections.abc import Iterator

import numpy as np
import pytest

A_FEW = 40
MANY = 1000

FEW_OR_MANY = pytest.mark.parametrize("count", [A_FEW, pytest.param(MANY, marks=pytest.mark.slow)])


def damages(
    whole: bytes, count: int, *, overwritten: int = 16, part: range | None = None
) -> Iterator[bytes]:
    """Yield damaged copies; the first few are the same in each run, many are new ones.

    Args:
        whole: the file.
        count: how many; one that comes out as the whole is left out.
        overwritten: most bytes that are overwritten at a place.
        part: half of the places are in this part of the file; None: there is no such part.
    """
    first = 0 if count < MANY else int.from_bytes(os.urandom(3))
    for seed in range(first, first + count):
        found = _damaged(whole, np.random.default_rng([23, seed]), overwritten, part)
        if found != whole:
            yield found


def _damaged(
    whole: bytes, random: np.random.Generator, overwritten: int, part: range | None
) -> bytes:
    """Flip one bit or eight, overwrite bytes, or cut the end off."""
    kind = random.integers(4)
    if kind == 3:
        return whole[: random.integers(len(whole))]
    data = bytearray(whole)
    places = part if part is not None and random.random() < 0.5 else range(len(data))
    place = int(random.integers(places.start, places.stop))
    if kind == 2:
        data[place : place + overwritten] = random.bytes(len(data[place : place + overwritten]))
    else:
        for at in place + random.integers(0, 16, 1 + 7 * kind):
            data[min(int(at), len(data) - 1)] ^= 1 << random.integers(8)
    return bytes(data)
