"""Decoder with truncated, damaged and foreign streams; ExposureAssembler."""

import random
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hardware.serial.codec import encode, split_lines
from hardware.serial.decoder import Decoder
from hardware.serial.decoder_benchmark import decode_mutated, decoding_rate
from hardware.serial.frame_builder import ExposureAssembler
from hardware.serial.messages import MAX_BYTES, DeviceStatus, Lines, LinesFlag, Start
from tests.hardware.serial.test_protocol import framed


def lines(sequence: int, counts: int = 16) -> Lines:
    values = np.random.default_rng(sequence).integers(0, 4096, counts).astype(np.uint16)
    return Lines(sequence, sequence * 200, 0, LinesFlag.NONE, 0, 0, values)


@given(st.lists(st.integers(1, 60), max_size=40))
def test_it_does_not_matter_how_reads_cut_the_stream(sizes: list[int]) -> None:
    stream = b"".join(encode(lines(n)) for n in range(8))
    decoder, found, place = Decoder(), [], 0
    for size in [*sizes, len(stream)]:
        found += decoder.feed(stream[place : place + size])
        place += size
    assert [message.sequence for message in found if isinstance(message, Lines)] == [*range(8)]
    assert decoder.counters.bytes_received == len(stream)
    assert decoder.counters.discarded == 0


@given(st.binary(max_size=500))
def test_after_anything_the_next_message_is_found(noise: bytes) -> None:
    decoder = Decoder()
    before = decoder.feed(noise)
    found = decoder.feed(b"\0" + encode(Start(5)))
    assert found[-1] == Start(5)
    assert len(before) + len(found) == 1


@pytest.mark.slow
def test_mutated_messages_give_nothing_that_was_not_sent() -> None:
    """Ten thousand here; `lumiline bench decoder` sends a million."""
    # In a process of its own: traced memory counts whatever other threads of a process allocate.
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as alone:
        found = alone.submit(decode_mutated, 10_000, seed=7).result()
    assert found.wrong == 0
    assert found.counters["garbled"] > 8_000
    # One in nine is sent twice, and one in nine has but a zero too many, somewhere.
    assert 1_500 < found.accepted < 3_500
    assert found.largest_kept <= 4096
    assert found.memory_bytes < 2_000_000


def test_the_check_of_mutations_sees_a_decoder_that_takes_anything(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("hardware.serial.decoder._crc32", lambda _: 0x2144DF1C)
    assert decode_mutated(300, seed=7).wrong > 10


@pytest.mark.parametrize("pixels", [1, 2560, 2561, 30000])
def test_frames_of_any_length_are_checked_to_their_last_byte(pixels: int) -> None:
    sent = lines(1, pixels)
    line = encode(sent)
    (received,) = Decoder().feed(b"\0" + line)
    assert isinstance(received, Lines)
    assert np.array_equal(received.counts, sent.counts)
    for at in (0, len(line) // 2, len(line) - 2):
        damaged = bytearray(line)
        damaged[at] ^= 0x55 if damaged[at] != 0x55 else 0x54
        decoder = Decoder()
        assert decoder.feed(b"\0" + damaged) == []
        assert decoder.counters.garbled == 1


def test_a_stream_without_zeros_is_not_kept() -> None:
    decoder = Decoder()
    for _ in range(40):
        assert decoder.feed(b"\x55" * 100_000) == []
        assert decoder.pending <= MAX_BYTES
    assert decoder.counters.too_long == 1
    assert decoder.feed(b"\x55\0" + encode(Start(1))) == [Start(1)]
    assert decoder.counters.too_long == 1


def test_a_message_that_is_too_long_is_dropped_in_one_read_or_many() -> None:
    long = b"\x01" * 300
    for pieces in ([long + b"\0"], [long[:200], long[200:] + b"\0"], [long[:100]] * 4 + [b"\0"]):
        decoder = Decoder(max_bytes=256)
        for piece in pieces:
            assert decoder.feed(piece) == []
        assert decoder.counters.too_long == 1
        assert decoder.feed(encode(Start(1))) == [Start(1)]


def test_other_versions_and_types_are_counted() -> None:
    decoder = Decoder()
    assert decoder.feed(framed(b"\x02\x02" + bytes(30)) + framed(b"\x01\x70abc")) == []
    assert decoder.counters.wrong_version == 1
    assert decoder.counters.unknown == 1
    assert decoder.counters.garbled == decoder.counters.malformed == 0


def test_the_rest_of_a_message_that_was_on_its_way_is_no_damage() -> None:
    decoder = Decoder()
    line = encode(lines(0))
    for _ in range(2):
        assert len(decoder.feed(line[20:] + line)) == 1
        assert decoder.counters.garbled == 0
        decoder.reset()
    decoder.feed(line + line[20:])
    assert decoder.counters.garbled == 1


def test_zeros_between_messages_are_nothing() -> None:
    decoder = Decoder()
    assert len(decoder.feed(bytes(50) + encode(Start(1)) + bytes(9) + encode(Start(2)))) == 2
    assert decoder.counters.discarded == 0


def test_its_rate_is_measured_on_whole_exposures() -> None:
    rate = decoding_rate(12, 2048, 0.01)
    assert rate.what == "12-bit noise, 4 messages an exposure"
    per_exposure = rate.megabytes_per_s * 1e6 / rate.frames_per_s
    assert 16_384 < per_exposure < 16_384 * 1.02
    assert rate.core_share_at_5_khz == pytest.approx(5000.0 / rate.frames_per_s)


def whole(sequence: int) -> Lines:
    return lines(sequence, 8)


@given(st.integers(1, 8), st.integers(0, 3))
def test_exposures_come_from_parts_of_any_size(size: int, sequence: int) -> None:
    assembler = ExposureAssembler(2, 4)
    stream = b"".join(encode(part) for part in split_lines(whole(sequence), size))
    *early, last = (part for part in Decoder().feed(stream) if isinstance(part, Lines))
    assert all(assembler.add(part) is None for part in early)
    exposed = assembler.add(last)
    assert exposed is not None
    assert np.array_equal(exposed.counts, whole(sequence).counts.reshape(2, 4))
    assert exposed.counts.shape == (2, 4)
    assert not exposed.counts.flags.writeable
    assert (exposed.sequence, exposed.ticks) == (sequence, sequence * 200)
    assert (assembler.incomplete, assembler.orphaned) == (0, 0)


@settings(max_examples=200)
@given(st.integers(0, 2**32), st.integers(1, 5))
def test_no_exposure_is_put_together_from_parts_of_two(seed: int, size: int) -> None:
    noise = random.Random(seed)
    assembler = ExposureAssembler(2, 4)
    sent = [part for sequence in range(20) for part in split_lines(whole(sequence), size)]
    kept = [part for part in sent if noise.random() > 0.2]
    for part in [one for one in kept for _ in range(1 + (noise.random() < 0.1))]:
        exposed = assembler.add(part)
        if exposed is not None:
            assert np.array_equal(exposed.counts.ravel(), whole(exposed.sequence).counts)


def test_missing_parts_are_counted() -> None:
    assembler = ExposureAssembler(2, 4)
    first = split_lines(whole(0), 4)
    second = split_lines(whole(1), 4)
    assert assembler.add(first[0]) is None
    assert assembler.add(second[1]) is None  # neither end is there
    assert (assembler.incomplete, assembler.orphaned) == (1, 1)
    assembler.add(second[0])
    assert assembler.add(whole(2)) is not None
    assert (assembler.incomplete, assembler.orphaned) == (2, 1)
    too_many = Lines(3, 0, 0, LinesFlag.NONE, 0, 4, np.zeros(8, np.uint16))
    assert assembler.add(too_many) is None
    assert (assembler.incomplete, assembler.orphaned) == (2, 2)


def test_a_part_that_is_saturated_makes_the_exposure_so() -> None:
    assembler = ExposureAssembler(2, 4)
    one, two = split_lines(whole(0), 4)
    flagged = Lines(
        one.sequence, one.ticks, one.marker, LinesFlag.SATURATED, one.lost, one.first, one.counts
    )
    assembler.add(flagged)
    exposed = assembler.add(two)
    assert exposed is not None
    assert exposed.flags == LinesFlag.SATURATED


def test_a_status_is_a_message_like_others() -> None:
    status = DeviceStatus(12345, 41.5, 3, 1)
    assert Decoder().feed(encode(status)) == [status]


@pytest.mark.parametrize("saturated", range(4))
def test_flags_are_those_of_all_parts(saturated: int) -> None:
    assembler = ExposureAssembler(4, 4)
    parts = split_lines(lines(1), 4)
    flagged = replace(parts[saturated], flags=LinesFlag.SATURATED)
    parts = [*parts[:saturated], flagged, *parts[saturated + 1 :]]
    assert [assembler.add(part) for part in parts[:-1]] == [None, None, None]
    exposed = assembler.add(parts[-1])
    assert exposed is not None
    assert exposed.flags == LinesFlag.SATURATED
    for part in split_lines(lines(2), 4):
        exposed = assembler.add(part)
    assert exposed is not None
    assert exposed.flags == LinesFlag.NONE
