"""Damaged recordings: bits flipped, bytes overwritten, files cut short, at random places."""

import os
from pathlib import Path

import numpy as np
import pytest

from compute.errors import InvalidRecording
from hardware.recording.reader import RecordingReader
from hardware.recording.writer import RecordingWriter
from tests.hardware.recording.blocks import assert_same_block, block, described


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    path = tmp_path_factory.mktemp("whole") / "r.h5"
    with RecordingWriter(path, described(), lines=True, results=True) as writer:
        for start in range(0, 96, 32):
            writer.append_block(block(start, 32))
    return path.read_bytes()


def damage(content: bytes, random: np.random.Generator) -> bytes:
    """Flip one to eight bits, overwrite up to 64 bytes, or cut the end off."""
    data = bytearray(content)
    kind = random.integers(4)
    if kind == 3:
        return content[: random.integers(len(content))]
    # Half of the places in the first part, where HDF5 has its headers and trees.
    place = int(random.integers(len(data) if random.random() < 0.5 else 4096))
    if kind == 2:
        data[place : place + 64] = random.bytes(len(data[place : place + 64]))
    else:
        for at in place + random.integers(0, 16, 1 + 7 * kind):
            data[min(int(at), len(data) - 1)] ^= 1 << random.integers(8)
    return bytes(data)


def check_damaged(whole: bytes, path: Path, seeds: range) -> int:
    """Read damaged files; return how many are refused. The others hold what was written."""
    refused = 0
    for seed in seeds:
        path.write_bytes(damage(whole, np.random.default_rng([17, seed])))
        try:
            with RecordingReader(path) as reader:
                found = reader.block(0, reader.info.frames)
                assert reader.info.description == described(), seed
        except InvalidRecording:
            refused += 1
            continue
        assert_same_block(found, block(0, len(found.rows)))
    return refused


def test_damaged_recordings_are_refused_or_hold_what_was_written(whole: bytes, tmp_path: Path):
    assert 20 < check_damaged(whole, tmp_path / "r.h5", range(120)) < 120


@pytest.mark.slow
def test_a_thousand_damaged_recordings(whole: bytes, tmp_path: Path):
    first = int.from_bytes(os.urandom(3))  # new ones in each run
    assert check_damaged(whole, tmp_path / "r.h5", range(first, first + 1000)) > 100
