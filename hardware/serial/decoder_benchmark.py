"""Robustness and speed of the decoder: mutated messages, and bytes per second."""

import random
import time
import tracemalloc
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Final

import numpy as np

from hardware.serial.codec import encode, parse, split_lines
from hardware.serial.decoder import Decoder
from hardware.serial.frame_builder import ExposureAssembler
from hardware.serial.messages import NO_MARKER, Lines, LinesFlag, Message

SENSORS: Final = 4
PIXELS: Final = 2048
READ_BYTES: Final = 2**18
_COUNTS: Final = 48


@dataclass(frozen=True)
class MutationStatistics:
    """Outcome of decoding mutated messages.

    Args:
        sent: messages, each mutated.
        accepted: messages that came out.
        wrong: accepted messages that were never sent.
        counters: the decoder's, by name.
        largest_kept: largest number of buffered bytes of an unfinished message.
        memory_bytes: peak memory of the decoding.
    """

    sent: int
    accepted: int
    wrong: int
    counters: dict[str, int]
    largest_kept: int
    memory_bytes: int


@dataclass(frozen=True)
class DecodingRate:
    """Decoding rate of exposures of 4 x 2048 pixels on one core.

    Args:
        what: the counts, and how they were split.
        megabytes_per_s: of bytes on the line.
        frames_per_s: whole exposures.
        core_share_at_5_khz: of one core.
    """

    what: str
    megabytes_per_s: float
    frames_per_s: float
    core_share_at_5_khz: float


def decode_mutated(
    messages: int, seed: int, report: Callable[[int], None] = lambda _: None
) -> MutationStatistics:
    """Decode mutated messages: flipped bits; lost, repeated and foreign bytes.

    A decoded message that was never sent is wrong, whatever its checksum.
    """
    noise = random.Random(seed)  # noqa: S311 - reproducible
    decoder = Decoder(max_bytes=4096)
    accepted = wrong = largest = 0
    sent: dict[int, bytes] = {}
    previous = b"\0"
    tracemalloc.start()
    try:
        for sequence in range(messages):
            line = encode(_lines(noise, sequence))
            sent[sequence] = line
            data = _mutate(noise, line, previous)
            previous = line
            # In pieces, as reads cut them.
            cut = noise.randrange(len(data) + 1)
            for piece in (data[:cut], data[cut:]):
                for message in decoder.feed(piece):
                    accepted += 1
                    wrong += not _was_sent(message, sent)
                largest = max(largest, decoder.pending)
            sent.pop(sequence - 16, None)
            if sequence % 10_000 == 0:
                report(sequence)
        _, memory = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    return MutationStatistics(messages, accepted, wrong, asdict(decoder.counters), largest, memory)


def _lines(noise: random.Random, sequence: int) -> Lines:
    """Return scans with many or few zero bytes, as counts have."""
    top = noise.choice((2, 256, 4096, 65536))
    counts = np.frombuffer(noise.randbytes(2 * _COUNTS), "<u2") % np.uint32(top)
    return Lines(sequence, noise.getrandbits(64), NO_MARKER, LinesFlag.NONE, 0, 0,
                 counts.astype(np.uint16))  # fmt: skip


def _mutate(noise: random.Random, line: bytes, previous: bytes) -> bytes:
    data = bytearray(line)
    start = noise.randrange(len(data))
    end = min(len(data), start + noise.randrange(1, 40))
    kind = noise.randrange(9)
    if kind == 0:
        for _ in range(noise.randrange(1, 9)):
            data[noise.randrange(len(data))] ^= 1 << noise.randrange(8)
    elif kind == 1:
        del data[start:end]
    elif kind == 2:
        data[start:start] = data[start:end]
    elif kind == 3:
        data[start:start] = b"\0"
    elif kind == 4:
        data[start:start] = noise.randbytes(noise.randrange(1, 200))
    elif kind == 5:
        data[start:end] = noise.randbytes(end - start)
    elif kind == 6:
        del data[start:]
    elif kind == 7:  # two cut together
        data[start:] = previous[min(start, len(previous)) :]
    else:  # the whole, twice
        data = data + data
    return bytes(data)


def _was_sent(message: Message, sent: dict[int, bytes]) -> bool:
    return isinstance(message, Lines) and encode(message) == sent.get(message.sequence)


def decoding_rate(bits: int, part_counts: int, seconds: float) -> DecodingRate:
    """Measure the decoding rate for exposures of ``bits``-bit noise, in processor time."""
    rng = np.random.default_rng(1)
    size = SENSORS * PIXELS
    frames = 64
    lines = [
        encode(part)
        for sequence in range(frames)
        for part in split_lines(
            Lines(sequence, sequence * 200, NO_MARKER, LinesFlag.NONE, 0, 0,
                  rng.integers(0, 2**bits, size).astype(np.uint16)),
            part_counts,
        )
    ]  # fmt: skip
    stream = b"".join(lines)
    decoder, assembler = Decoder(), ExposureAssembler(SENSORS, PIXELS)
    decoded = passes = 0
    begin = time.process_time()
    while (spent := time.process_time() - begin) < seconds:
        for start in range(0, len(stream), READ_BYTES):
            for message in decoder.feed(stream[start : start + READ_BYTES]):
                assert isinstance(message, Lines)
                decoded += assembler.add(message) is not None
        passes += 1
    assert decoded == passes * frames
    split = "one message" if part_counts >= size else f"{size // part_counts} messages"
    return DecodingRate(
        f"{bits}-bit noise, {split} an exposure",
        passes * len(stream) / spent * 1e-6,
        decoded / spent,
        5000.0 * spent / decoded,
    )


def stages_us(bits: int = 12) -> dict[str, float]:
    """Return the processor time of each decoding stage per exposure [us]."""
    from zlib import crc32

    from cobs import cobs

    rng = np.random.default_rng(1)
    counts = rng.integers(0, 2**bits, SENSORS * PIXELS).astype(np.uint16)
    line = encode(Lines(1, 2, NO_MARKER, LinesFlag.NONE, 0, 0, counts))
    content = cobs.decode(line[:-1])
    batch = line * 16
    stages: dict[str, tuple[Callable[[], object], int]] = {
        "split at zeros": (lambda: batch.split(b"\0"), 16),
        "COBS": (lambda: cobs.decode(line[:-1]), 1),
        "CRC-32": (lambda: crc32(content), 1),
        "parse": (lambda: parse(content[:-4]), 1),
    }
    return {name: _min_us(call) / exposures for name, (call, exposures) in stages.items()}


def _min_us(call: Callable[[], object], repeats: int = 7, calls: int = 100) -> float:
    least = float("inf")
    for _ in range(repeats):
        begin = time.process_time()
        for _ in range(calls):
            call()
        least = min(least, (time.process_time() - begin) / calls)
    return least * 1e6
