"""Commands out of bytes, and the checksums."""

import itertools

import pytest
from fastcrc import crc16
from hypothesis import given
from hypothesis import strategies as st

from service.protocols.ndi.command import (
    BREAK,
    MAX_BYTES,
    Command,
    CommandError,
    CommandReader,
    ErrorCode,
    Received,
    binary_reply,
    parse,
    text_reply,
)

NAMES = st.from_regex(r"[A-Z0-9]{1,10}", fullmatch=True)
TEXTS = st.text(st.characters(min_codepoint=0x20, max_codepoint=0x7E), max_size=60)


def read(*pieces: bytes) -> list[Received]:
    reader = CommandReader()
    return [one for piece in pieces for one in reader.feed(piece)]


def with_crc(text: str) -> bytes:
    return text.encode() + b"%04X\r" % crc16.arc(text.encode())


@pytest.mark.parametrize(
    ("data", "known"),
    [
        # What drivers have as fixed strings.
        (b"INIT:", 0xE3A5),
        (b"VER:0", 0x65EE),
        (b"GETINFO:Features.Firmware.Version", 0x0492),
        (b"OKAY", 0xA896),
        (b"RESET", 0xBE6F),
        # The check value of CRC-16/ARC.
        (b"123456789", 0xBB3D),
    ],
)
def test_known_checksums(data: bytes, known: int):
    assert crc16.arc(data) == known


@given(st.binary(max_size=300))
def test_a_checksum_over_the_whole_binary_reply_agrees(body: bytes):
    """Some drivers check the data alone, others all that came."""
    reply = binary_reply(body)
    assert reply[:2] == b"\xc4\xa5"
    assert int.from_bytes(reply[2:4], "little") == len(body) == len(reply) - 8
    assert int.from_bytes(reply[4:6], "little") == crc16.arc(reply[:4])
    assert int.from_bytes(reply[-2:], "little") == crc16.arc(reply[6:-2]) == crc16.arc(reply[:-2])


def test_replies_are_ascii():
    assert text_reply("OKAY") == b"OKAYA896\r"
    assert text_reply("caf\u00e9")[:-5] == b"caf?"


@given(st.lists(st.tuples(NAMES, TEXTS, st.booleans()), max_size=8), st.data())
def test_any_split_of_the_bytes_gives_the_same_commands(
    given_: list[tuple[str, str, bool]], data: st.DataObject
):
    stream = b"".join(
        with_crc(f"{name}:{text}") if crc else f"{name} {text}\r".encode()
        for name, text, crc in given_
    )
    cuts = data.draw(st.lists(st.integers(0, len(stream)), max_size=6).map(sorted))
    ends = [0, *cuts, len(stream)]
    pieces = [stream[one:two] for one, two in itertools.pairwise(ends)]
    assert read(*pieces) == [Command(name, text) for name, text, _ in given_]


@given(st.binary(max_size=6000))
def test_no_bytes_do_harm(data: bytes):
    reader = CommandReader()
    for one in reader.feed(data):
        assert isinstance(one, Command | ErrorCode) or one is BREAK
    # What came before does not matter behind the next end of a line.
    list(reader.feed(b"\r"))
    assert list(reader.feed(b"INIT:E3A5\r")) == [Command("INIT", "")]


@given(NAMES, TEXTS, st.integers(0, 0xFFFF))
def test_another_checksum_is_refused(name: str, text: str, wrong: int):
    line = f"{name}:{text}".encode()
    if wrong == crc16.arc(line):
        wrong ^= 1
    with pytest.raises(CommandError) as caught:
        parse(line + b"%04X" % wrong)
    assert caught.value.code is ErrorCode.BAD_CRC


@pytest.mark.parametrize(
    ("line", "code"),
    [
        (b"", ErrorCode.TOO_SHORT),
        (b"\n", ErrorCode.TOO_SHORT),
        (b"TX:1", ErrorCode.TOO_SHORT),
        (b"TX:000G", ErrorCode.BAD_CRC),
        (b" TX", ErrorCode.INVALID_COMMAND),
        (b"?", ErrorCode.INVALID_COMMAND),
        (b"TX \xff", ErrorCode.INVALID_COMMAND),
        (b"\xc4\xa5", ErrorCode.INVALID_COMMAND),
    ],
)
def test_what_is_no_command(line: bytes, code: ErrorCode):
    assert read(line + b"\r") == [code]


def test_forms():
    expected = [Command("TX", "0001"), Command("TX", ""), Command("TX", ""), Command("TX", "")]
    assert read(b"tx 0001\r\nTX\rTX \r" + with_crc("TX:")) == expected


def test_too_long():
    """Nothing of it is kept, and it is told once."""
    longest = b"ECHO " + b"x" * (MAX_BYTES - 5)
    assert read(longest + b"\r") == [Command("ECHO", "x" * (MAX_BYTES - 5))]
    reader = CommandReader()
    assert list(reader.feed(longest)) == []
    for _ in range(100):
        assert list(reader.feed(b"y" * 4096)) == []
        assert len(reader._line) == 0
    assert list(reader.feed(b"\rINIT\r")) == [ErrorCode.TOO_LONG, Command("INIT", "")]


def test_a_break_throws_away_what_came_before():
    assert read(b"TSTA\x00\x00", b"\x00INIT\r") == [BREAK, Command("INIT", "")]
    assert read(b"\x00\r\x00") == [BREAK, ErrorCode.TOO_SHORT, BREAK]
