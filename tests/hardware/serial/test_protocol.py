"""Encoder and parser: documented bytes, round trips, invalid content."""

import math
import re
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from cobs import cobs
from hypothesis import given
from hypothesis import strategies as st

from compute.errors import InvalidParameter
from hardware.serial.codec import encode, split_lines
from hardware.serial.decoder import Decoder
from hardware.serial.messages import (
    MAX_BYTES,
    NO_MARKER,
    Ability,
    Answer,
    Describe,
    Description,
    DeviceStatus,
    Exposure,
    Lines,
    LinesFlag,
    Message,
    Start,
    Stop,
    Strobe,
)

DOCUMENT = Path(__file__).parents[3] / "docs" / "reference" / "serial-protocol.md"

EXAMPLES: dict[str, Message] = {
    "lines": Lines(
        7, 1_000_000, 1, LinesFlag.SATURATED, 0, 0, np.array([100, 4095, 0, 101], np.uint16)
    ),
    "description": Description(
        name="bar-0017",
        sensors=("left", "right"),
        pixels=2,
        pitch_um=14.0,
        clock_hz=1_000_000,
        clock_bits=32,
        bits=12,
        electrons_per_count=12.0,
        read_noise_electrons=30.0,
        offset_counts=64.0,
        frame_rate_hz=1000.0,
        exposure_us=200.0,
        delay_us=350.0,
        markers=2,
        abilities=Ability.START_STOP | Ability.EXPOSURE | Ability.STROBE,
    ),
    "start": Start(1),
    "strobe": Strobe(2, (0, 1, NO_MARKER)),
}


def decoded(line: bytes) -> Message:
    decoder = Decoder()
    (message,) = decoder.feed(line)
    return message


def same(one: Message, other: Message) -> bool:
    if isinstance(one, Lines) and isinstance(other, Lines):
        names = [name for name in Lines.__slots__ if name != "counts"]
        return all(getattr(one, name) == getattr(other, name) for name in names) and np.array_equal(
            one.counts, other.counts
        )
    return one == other


@pytest.mark.parametrize("name", EXAMPLES)
def test_the_documented_bytes_are_those_of_the_encoder(name: str) -> None:
    text = DOCUMENT.read_text(encoding="utf-8")
    found = re.search(
        rf"^### Example: {name}\n.*?^On the line:\n\n```\n(.*?)```", text, re.M | re.S
    )
    assert found is not None, f"the document has no example {name}"
    line = bytes.fromhex(found[1])
    assert encode(EXAMPLES[name]) == line
    assert same(decoded(line), EXAMPLES[name])


def test_the_documented_content_is_what_cobs_carries() -> None:
    text = DOCUMENT.read_text(encoding="utf-8")
    found = re.search(r"^### Example: lines\n.*?```\n(.*?)```", text, re.M | re.S)
    assert found is not None
    content = b"".join(bytes.fromhex(row[:24]) for row in found[1].splitlines())
    assert cobs.decode(encode(EXAMPLES["lines"])[:-1]) == content


f32 = st.floats(0.0, 1e6, width=32)
names = st.text(st.characters(codec="utf-8", exclude_categories=["Cs"]), min_size=1, max_size=16)
u16, u32, u64 = (st.integers(0, 2**bits - 1) for bits in (16, 32, 64))
messages: st.SearchStrategy[Message] = st.one_of(
    st.builds(
        Description,
        name=names,
        sensors=st.lists(names, min_size=1, max_size=8, unique=True).map(tuple),
        pixels=st.integers(1, 65535),
        pitch_um=st.floats(0.5, 1000.0, width=32),
        clock_hz=st.integers(1, 2**32 - 1),
        clock_bits=st.integers(16, 64),
        bits=st.integers(1, 16),
        electrons_per_count=st.floats(0.5, 1e4, width=32),
        read_noise_electrons=f32,
        offset_counts=f32,
        frame_rate_hz=f32,
        exposure_us=f32,
        delay_us=f32,
        line_sigma_px=f32,
        markers=st.integers(0, 254),
        abilities=st.integers(0, 7).map(Ability),
    ),
    st.builds(
        Lines,
        sequence=u32,
        ticks=u64,
        marker=st.integers(0, 255),
        flags=st.integers(0, 1).map(LinesFlag),
        lost=u32,
        first=u32,
        counts=st.lists(u16, min_size=1, max_size=300).map(lambda x: np.array(x, np.uint16)),
    ),
    st.builds(DeviceStatus, ticks=u64, temperature_c=f32, lost=u32, garbled=u32),
    st.builds(Answer, command=st.integers(0, 255), number=u16, result=st.integers(0, 255)),
    st.builds(Describe, number=u16),
    st.builds(Start, number=u16),
    st.builds(Stop, number=u16),
    st.builds(Exposure, number=u16, frame_rate_hz=f32, exposure_us=f32),
    st.builds(
        Strobe,
        number=u16,
        slots=st.lists(st.sampled_from([*range(254), NO_MARKER]), max_size=254).map(tuple),
    ),
)


@given(messages)
def test_what_was_encoded_is_decoded(message: Message) -> None:
    line = encode(message)
    assert line.index(b"\0") == len(line) - 1
    assert same(decoded(line), message)


@pytest.mark.parametrize(
    ("message", "words"),
    [
        (Start(-1), "room"),
        (Exposure(1, 1e39, 0.0), "room"),
        (Describe(2**16), "room"),
        (Lines(0, 0, 256, LinesFlag.NONE, 0, 0, np.zeros(1, np.uint16)), "room"),
        (Lines(0, 0, 0, LinesFlag.NONE, 0, 0, np.ones(MAX_BYTES // 2, np.uint16)), "in parts"),
        (Description("", ("a",), 8, 14.0, 1), "1 to 64"),
        (Description("x" * 65, ("a",), 8, 14.0, 1), "65 bytes"),
    ],
)
def test_what_has_no_room_is_refused(message: Message, words: str) -> None:
    with pytest.raises(InvalidParameter, match=words):
        encode(message)


def framed(content: bytes) -> bytes:
    """A message with a right checksum, whatever it says."""
    checked = content + struct.pack("<I", zlib.crc32(content))
    line: bytes = cobs.encode(checked) + b"\0"
    return line


GOOD: bytes = cobs.decode(encode(EXAMPLES["description"])[:-1])[:-4]


def changed(place: int, value: bytes) -> bytes:
    return GOOD[:place] + value + GOOD[place + len(value) :]


@pytest.mark.parametrize(
    "content",
    [
        b"\x01\x02" + bytes(22),  # lines without counts
        b"\x01\x02" + bytes(25),  # half a count
        b"\x01\x01" + bytes(10),  # a description cut short
        GOOD[:-3],  # the last name cut short
        changed(4, b"\x00"),  # no sensors
        changed(6, b"\x00\x00"),  # no pixels
        changed(8, b"\x08"),  # a clock of 8 bits
        changed(10, bytes(4)),  # that stands still
        changed(14, struct.pack("<f", math.nan)),
        changed(18, struct.pack("<f", -1.0)),
        changed(22, struct.pack("<f", math.inf)),
        changed(26, struct.pack("<f", math.nan)),
        changed(14 + 32, b"\xff"),  # a name of 255 bytes
        changed(14 + 33, b"\xff"),  # that is no UTF-8
        GOOD.replace(b"\x05right", b"\x04left"),
        b"\x01\x84\x01\x00" + struct.pack("<ff", math.inf, 0.0),
        b"\x01\x85\x01\x00\x03\x01\x02",  # three slots announced, two there
        b"\x01\x85\x01\x00\x01\xfe",  # marker 254
        b"\x01\x82\x01",
    ],
)
def test_content_that_makes_no_sense_is_malformed(content: bytes) -> None:
    decoder = Decoder()
    assert decoder.feed(framed(GOOD)) == [EXAMPLES["description"]]
    assert decoder.feed(framed(content)) == []
    assert decoder.counters.malformed == 1
    assert decoder.feed(framed(GOOD)) == [EXAMPLES["description"]]


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (changed(14, struct.pack("<f", 0.0)), "with pixel pitch 0; it must be above 0"),
        (changed(18, struct.pack("<f", 0.0)), "with gain 0; it must be above 0"),
        (changed(22, struct.pack("<f", -1.0)), "with read noise -1; it must be 0 to 1e+09"),
        (changed(26, struct.pack("<f", math.nan)), "with offset nan; it must be"),
        (changed(42, struct.pack("<f", math.inf)), "with line width inf; it must be"),
        (changed(8, b"\x08"), "with number of bits of the clock 8; it must be 16 to 64"),
        (changed(14 + 33, b"\xff"), r"with a name not in UTF-8: b'\xff"),
        (GOOD.replace(b"\x05right", b"\x04left"), "with sensors of one name: left, left"),
        (GOOD[:30], "description came that ends too early"),
        (b"\x02" + GOOD[1:], "of version 2 of the protocol; this is version 1"),
    ],
)
def test_what_is_wrong_with_a_whole_message_is_said(content: bytes, words: str) -> None:
    decoder = Decoder()
    assert decoder.feed(framed(content)) == []
    assert words in (decoder.complaint or "")
    decoder.reset()
    assert decoder.complaint is None


def test_parts_have_all_counts_and_their_places() -> None:
    whole = EXAMPLES["lines"]
    assert isinstance(whole, Lines)
    parts = split_lines(whole, 3)
    assert [(part.first, part.counts.tolist()) for part in parts] == [
        (0, [100, 4095, 0]),
        (3, [101]),
    ]
    assert {part.sequence for part in parts} == {7}
