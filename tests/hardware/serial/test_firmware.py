"""The firmware's C encoder and receiver, byte by byte against the host's codec and decoder."""

import math
import struct
import subprocess
import zlib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cobs import cobs
from hypothesis import given, settings
from hypothesis import strategies as st

from hardware.serial.codec import MalformedMessage, encode, parse
from hardware.serial.decoder import Decoder
from hardware.serial.driver import SerialDriver
from hardware.serial.messages import (
    MAX_BYTES,
    NO_MARKER,
    VERSION,
    Ability,
    Answer,
    Describe,
    Description,
    DeviceStatus,
    Exposure,
    FromHost,
    Lines,
    LinesFlag,
    MessageType,
    Start,
    Stop,
    Strobe,
)
from hardware.serial.settings import SerialSettings
from hardware.strobe_schedule import StrobeSchedule
from tests.hardware.serial.firmware_library import (
    FIRMWARE,
    SANITIZERS,
    Firmware,
    c_compiler,
    compile_c,
    sanitizes,
)
from tests.hardware.serial.test_protocol import EXAMPLES

pytestmark = pytest.mark.skipif(c_compiler() is None, reason="no C compiler (cc, gcc)")

u8, u16 = st.integers(0, 2**8 - 1), st.integers(0, 2**16 - 1)
u32, u64 = st.integers(0, 2**32 - 1), st.integers(0, 2**64 - 1)


def f32(low: float, high: float, **options: bool) -> st.SearchStrategy[float]:
    return st.floats(low, high, width=32, allow_nan=False, **options)


above_zero = f32(2.0**-100, 1e9)


def random_counts(seed: int, count: int, bound: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, bound, count).astype(np.uint16)


# Zeros, and runs without a zero that are longer than a block of COBS.
counts = st.one_of(
    st.lists(u16, min_size=1, max_size=40).map(lambda values: np.array(values, np.uint16)),
    st.integers(1, 700).map(lambda n: np.full(n, 0x0101, np.uint16)),
    st.integers(1, 700).map(lambda n: np.zeros(n, np.uint16)),
    st.builds(random_counts, u32, st.integers(1, 900), st.integers(1, 2**16)),
)
lines = st.builds(Lines, u32, u64, u8, st.sampled_from(LinesFlag), u32, u32, counts)
letters = st.characters(exclude_characters="\0", codec="utf-8")
name = st.text(letters, min_size=1, max_size=64).filter(lambda text: len(text.encode()) <= 64)
descriptions = st.builds(
    Description,
    name=name,
    sensors=st.lists(name, min_size=1, max_size=8, unique=True).map(tuple),
    pixels=st.integers(1, 2**16 - 1),
    pitch_um=above_zero,
    clock_hz=st.integers(1, 2**32 - 1),
    clock_bits=st.integers(16, 64),
    bits=st.integers(1, 16),
    electrons_per_count=above_zero,
    read_noise_electrons=f32(0.0, 1e9),
    offset_counts=f32(-1e9, 1e9),
    frame_rate_hz=f32(0.0, 1e6),
    exposure_us=f32(0.0, 1e9),
    delay_us=f32(0.0, 1e9),
    line_sigma_px=f32(0.0, 1e9),
    markers=st.integers(0, 254),
    abilities=st.integers(0, 7).map(Ability),
)
slots = st.one_of(
    st.lists(u8.filter(lambda slot: slot != 254), max_size=20),
    # Runs without a zero that fill a block of COBS, and the longest command.
    st.integers(235, 254).map(lambda count: [1 + at % 200 for at in range(count)]),
).map(tuple)
commands = st.one_of(
    st.builds(Describe, u16),
    st.builds(Start, u16),
    st.builds(Stop, u16),
    st.builds(Exposure, u16, f32(0.0, 2.0**100), f32(0.0, 2.0**100)),
    st.builds(Strobe, u16, slots),
)


@pytest.fixture(scope="module")
def firmware(tmp_path_factory: pytest.TempPathFactory) -> Firmware:
    return Firmware(tmp_path_factory.mktemp("firmware"))


def command_tuple(message: FromHost) -> tuple[object, ...]:
    """A command as ``Firmware.received`` has it."""
    rate, exposure, slots = 0.0, 0.0, ()
    if isinstance(message, Exposure):
        rate, exposure = message.frame_rate_hz, message.exposure_us
    if isinstance(message, Strobe):
        slots = message.slots
    kind = MessageType[type(message).__name__.upper()]
    return int(kind), message.number, rate, exposure, slots


# What the device sends.


def test_the_documented_messages_are_encoded_as_documented(firmware: Firmware) -> None:
    shown, described = EXAMPLES["lines"], EXAMPLES["description"]
    assert isinstance(shown, Lines)
    assert isinstance(described, Description)
    assert firmware.lines(shown) == encode(shown)
    assert firmware.description(described) == encode(described)


@given(message=lines, data=st.data())
def test_lines_are_the_reference_encoders_bytes(
    firmware: Firmware, message: Lines, data: st.DataObject
) -> None:
    expected = encode(message)
    assert firmware.lines(message) == expected
    cuts = data.draw(st.lists(st.integers(0, len(message.counts)), max_size=4))
    assert firmware.lines(message, cuts) == expected
    (decoded,) = Decoder().feed(expected)
    assert isinstance(decoded, Lines)
    assert np.array_equal(decoded.counts, message.counts)


@pytest.mark.parametrize("count", [*range(1, 4), *range(111, 116), *range(238, 243)])
def test_messages_that_end_with_a_zero_or_a_full_block_are_the_reference_encoders_bytes(
    firmware: Firmware, count: int
) -> None:
    ends = set()
    for sequence in range(1000):
        counts = np.full(count, 0x0101 + sequence % 200, np.uint16)
        number = 0x01010101 + sequence
        message = Lines(number, 2**64 - 1, 255, LinesFlag.SATURATED, number, number, counts)
        line = encode(message)
        assert firmware.lines(message) == line
        ends.add("zero" if line[-2] == 1 else "full" if line[-256:-255] == b"\xff" else "other")
    assert {"zero", "other"} <= ends
    assert count not in (113, 240) or "full" in ends


@given(message=descriptions)
def test_descriptions_are_the_reference_encoders_bytes(
    firmware: Firmware, message: Description
) -> None:
    line = firmware.description(message)
    assert line == encode(message)
    assert firmware.check(message) is None
    assert Decoder().feed(line) == [message]


@given(message=st.builds(DeviceStatus, u64, st.floats(width=32), u32, u32))
def test_statuses_are_the_reference_encoders_bytes(
    firmware: Firmware, message: DeviceStatus
) -> None:
    line = firmware.status(message)
    (decoded,) = Decoder().feed(line)
    assert isinstance(decoded, DeviceStatus)
    if math.isnan(message.temperature_c):  # Which bits a NaN has is the interpreter's choice.
        message = decoded = replace(decoded, temperature_c=0.0)
    else:
        assert line == encode(message)
    assert decoded == message


@given(message=st.builds(Answer, u8, u16, u8))
def test_answers_are_the_reference_encoders_bytes(firmware: Firmware, message: Answer) -> None:
    assert firmware.answer(message) == encode(message)


bounds = st.sampled_from([0.0, -1e9, 1e6, 1e9, -1.0, -1.1e9, 1.1e6, 1.1e9, math.inf, math.nan])


@pytest.mark.slow
@given(
    message=descriptions,
    changes=st.fixed_dictionaries(
        {},
        optional={
            "bits": u8,
            "clock_bits": u8,
            "markers": u8,
            "pixels": u16,
            "clock_hz": st.sampled_from([0, 1]),
            "pitch_um": bounds,
            "electrons_per_count": bounds,
            "read_noise_electrons": bounds,
            "offset_counts": bounds,
            "frame_rate_hz": bounds,
            "exposure_us": bounds,
            "delay_us": bounds,
            "line_sigma_px": bounds,
            "sensors": st.sampled_from([("a", "a"), ("a", ""), ("a" * 65,), ("a", "b", "ab")]),
        },
    ),
)
@settings(max_examples=300)
def test_the_check_refuses_exactly_the_descriptions_that_the_host_refuses(
    firmware: Firmware, message: Description, changes: dict[str, object]
) -> None:
    message = replace(message, **changes)
    content = cobs.decode(firmware.description(message)[:-1])
    try:
        parse(content[:-4])
        accepted = True
    except MalformedMessage:
        accepted = False
    assert (firmware.check(message) is None) == accepted


def test_the_largest_message_fits_and_a_larger_one_might_not(firmware: Firmware) -> None:
    text = (FIRMWARE / "lumiline_serial.h").read_text()
    largest = int(text.split("LUMILINE_MAX_COUNTS ")[1].split("u")[0])
    content = 28 + 2 * largest
    assert content + -(-content // 254) + 1 <= MAX_BYTES
    content += 2
    assert content + -(-content // 254) + 1 > MAX_BYTES
    full = np.full(largest, 0xFFFF, np.uint16)
    message = Lines(2**32 - 1, 2**64 - 1, 255, LinesFlag.SATURATED, 2**32 - 1, 2**32 - 1, full)
    assert firmware.lines(message) == encode(message)


# What it receives.


@given(messages=st.lists(commands, max_size=5), zeros=st.integers(0, 2))
def test_commands_are_received_as_sent(
    firmware: Firmware, messages: list[FromHost], zeros: int
) -> None:
    data = b"".join(encode(message) + b"\0" * zeros for message in messages)
    assert firmware.received(data) == ([command_tuple(message) for message in messages], 0)


@st.composite
def damaged(draw: st.DrawFn) -> bytes:
    """Commands with flipped, lost and inserted bytes."""
    data = bytearray(b"".join(map(encode, draw(st.lists(commands, min_size=1, max_size=4)))))
    for _ in range(draw(st.integers(0, 4))):
        at = draw(st.integers(0, len(data) - 1))
        match draw(st.sampled_from(["flip", "lose", "insert"])):
            case "flip":
                data[at] ^= draw(st.integers(1, 255))
            case "lose" if len(data) > 1:
                del data[at]
            case _:
                data[at:at] = draw(st.binary(max_size=3))
    return bytes(data)


@given(data=st.one_of(st.binary(max_size=400), damaged()))
def test_of_damaged_bytes_exactly_the_intact_commands_are_received(
    firmware: Firmware, data: bytes
) -> None:
    decoder = Decoder()
    decoder.feed(b"\0")  # the host counts nothing before the first zero
    messages = decoder.feed(data)
    wanted = [command_tuple(message) for message in messages]
    assert firmware.received(data) == (wanted, decoder.counters.discarded)


def strobe_body(listed: list[int] | tuple[int, ...]) -> bytes:
    return bytes([7, 0, len(listed), *listed])


@given(
    content=st.one_of(
        st.binary(min_size=0, max_size=270),
        slots.map(strobe_body),
        st.lists(st.sampled_from([0, 253, 254, 255]), max_size=4).map(strobe_body),
    ),
    version=st.sampled_from([VERSION, VERSION, VERSION, VERSION, 0, 2]),
    kind=st.sampled_from([0x85, 0x85, 0x84, 0x81, 0x82, 0x90]),
)
@settings(max_examples=100)
def test_of_intact_messages_exactly_the_valid_commands_are_received(
    firmware: Firmware, content: bytes, version: int, kind: int
) -> None:
    content = bytes([version, kind]) + content
    line = cobs.encode(content + struct.pack("<I", zlib.crc32(content))) + b"\0"
    received, discarded = firmware.received(line)
    decoder = Decoder()
    messages = decoder.feed(line)
    if kind == 0x90 and version == VERSION and 4 <= len(content) <= 266:
        # A newer host's: it is answered, by LUMILINE_UNKNOWN.
        assert received == [(kind, int.from_bytes(content[2:4], "little"), 0.0, 0.0, ())]
    elif kind == 0x90 or len(line) > 273:
        assert (received, discarded) == ([], 1)
    else:
        assert received == [command_tuple(message) for message in messages]
        assert discarded == 1 - len(messages)


def test_random_bytes_break_no_rule_of_memory(tmp_path: Path) -> None:
    program = tmp_path / "receive_all"
    harness = Path(__file__).with_name("receive_all.c")
    if not sanitizes(tmp_path):
        pytest.skip("the compiler has no sanitizers")
    compile_c(*SANITIZERS, "-I", str(FIRMWARE), str(harness), str(FIRMWARE / "lumiline_serial.c"),
              "-o", str(program))  # fmt: skip
    rng = np.random.default_rng(5)
    pieces = []
    for length in rng.integers(1, 300, 3000):
        piece = rng.integers(1, 256, length).astype(np.uint8)
        at = 0
        while at < length:  # codes that reach just to the end, and beyond it
            piece[at] = min(rng.integers(1, 256), length - at + rng.integers(0, 3))
            at += max(int(piece[at]), 1)
        pieces.append(piece.tobytes())
    data = b"\0".join(pieces) + b"\0"
    done = subprocess.run([program], input=data, capture_output=True)
    assert done.returncode == 0, done.stderr.decode()
    decoder = Decoder()
    decoder.feed(b"\0")
    decoder.feed(data)
    assert done.stdout.decode() == f"0 {decoder.counters.discarded}\n"


# A whole device.


@pytest.fixture
def example_device(tmp_path: Path) -> Iterator[str]:
    """Address of the example device, in a process of its own."""
    program = tmp_path / "example_device"
    sources = [str(FIRMWARE / file) for file in ("example_device.c", "lumiline_serial.c")]
    compile_c("-O2", *sources, "-lm", "-o", str(program))
    with subprocess.Popen([program, "0"], stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            yield process.stdout.readline().strip()
        finally:
            process.kill()


@pytest.mark.slow
def test_the_example_device_is_driven_as_any_other(example_device: str) -> None:
    schedule = StrobeSchedule((0, 1, None))
    driver = SerialDriver(
        "bar", SerialSettings(example_device, frame_rate_hz=200.0, strobe=schedule)
    )
    driver.open()
    try:
        assert driver.description.frame_rate_hz == 200.0
        stream = driver.frames()
        frames = [next(stream) for _ in range(30)]
    finally:
        driver.close()
    assert [frame.marker for frame in frames] == [0, 1, None] * 10
    assert [frame.sequence for frame in frames] == list(range(30))
    # One marker's light, then the other's, then both.
    light = [(frame.lines > 1000).sum(axis=1) for frame in frames[:3]]
    assert np.all(np.concatenate(light[:2]) > 5)
    assert np.all(light[2] > np.maximum(light[0], light[1]))
    counters = driver.link().counters
    assert (counters.frames_garbled, counters.frames_incomplete, counters.frames_lost) == (0, 0, 0)


def test_the_strobe_of_the_schedule_has_the_protocols_number_for_all() -> None:
    assert f"LUMILINE_ALL_MARKERS {NO_MARKER}u" in (FIRMWARE / "lumiline_serial.h").read_text()
