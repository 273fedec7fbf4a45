"""Messages to bytes and back: against the protocol's published examples, pyigtl, and chance."""

import contextlib
import struct

import numpy as np
import pyigtl
import pytest
from fastcrc import crc64
from hypothesis import given, settings
from hypothesis import strategies as st

from compute.transform import rotation_matrix
from service.protocols.openigtlink.bodies import (
    Command,
    Point,
    StartStream,
    read_command,
    read_start,
    read_string,
    write_capability,
    write_command,
    write_points,
    write_position,
    write_status,
    write_string,
    write_tracking,
    write_transform,
)
from service.protocols.openigtlink.message import (
    HEADER_BYTES,
    BadMessage,
    Damaged,
    Decoder,
    Message,
    Skipped,
    WrongChecksum,
    read_body,
    read_header,
    write_message,
)
from tests.service.protocols.openigtlink.readers import (
    read_capability,
    read_points,
    read_position,
    read_qtdata,
    read_status,
    read_tdata,
    read_transform,
    write_start,
)
from tests.service.protocols.openigtlink.test_client import Everything

COLUMNS = np.frombuffer(
    bytes.fromhex(
        "BF7473CD3E4959E6BE63DD98BE4959E63E12491B3F7852D6"
        "3E63DD983F7852D6BDC830AE42383660419BC46742383660"
    ),
    ">f4",
).astype(float)
ROTATION, TRANSLATION = COLUMNS[:9].reshape(3, 3).T, COLUMNS[9:]
AGES = {"First patient age": "22", "Second patient age": "25"}
TOOLS = [(f"Tracker{number}", ROTATION, TRANSLATION) for number in range(3)]
TRANSFORM = write_transform(ROTATION, TRANSLATION)
COMMAND = write_command(Command(5, "This is a test command", "Start the tracking machine"))
POSITION = struct.pack(">7f", *TRANSLATION, 0.0, *np.float32([0.5773502691] * 2), np.float32(1 / 3))


def checksum(data: bytes) -> int:
    return read_header(data[:HEADER_BYTES]).checksum


@pytest.mark.parametrize(
    ("content", "version", "published"),
    [
        (TRANSFORM, 1, 0xF6DD2B8EB4DF6DD2),
        (TRANSFORM, 2, 0xF698F64FDAE266DD),
        (write_status(15, "ACTUATOR_DISABLED", "Actuator A is disabled.", 10), 1,
         0x98EE43EED8E431CF),
        (write_string("Welcome to OpenIGTLink"), 1, 0xCEF1B42A701104D4),
        (write_tracking("TDATA", TOOLS), 1, 0x5C7CEBFD27676877),
        (write_tracking("TDATA", TOOLS), 2, 0xBD309E0E33101C37),
        (COMMAND, 1, 0x2BC7CD95B7C59545),
        (COMMAND, 2, 0x85D25EE941901770),
        (POSITION, 1, 0x6BC8D6282B79A3A1),
        (POSITION, 2, 0xC71116427681C1E2),
        (write_capability(["IMAGE", "GET_IMAGE", "TRANSFORM", "GET_TRANS"]), 1,
         0x6957E29E2B35EA1E),
        (write_points([
            Point("POINT_DESCRIPTION_0", "Landmark", (10, 15, 20), (255, 0, 0, 255), 5, "IMAGE_0"),
            Point("POINT_DESCRIPTION_1", "Landmark", (25, 30, 35), (0, 255, 0, 255), 3, "IMAGE_0"),
            Point("POINT_DESCRIPTION_2", "Landmark", (40, 45, 50), (0, 0, 255, 255), 1, "IMAGE_0"),
        ]), 1, 0xA55CC62D99C18210),
    ],
)  # fmt: skip
def test_published_examples(content: bytes, version: int, published: int):
    """The checksums in the test data of the protocol's own library, of the same values."""
    message = Message("ANY", "DeviceName", content, 0, version, AGES, 1)
    assert checksum(write_message(message)) == published


def test_position_is_the_quaternion_that_is_published():
    vector, quaternion = read_position(POSITION)
    again, turned = read_position(write_position(np.eye(3), vector))
    assert np.array_equal(again, vector)
    assert np.array_equal(turned, [0, 0, 0, 1])
    assert quaternion[3] == np.float32(1 / 3)


def test_the_header_of_the_published_transform():
    published = bytes.fromhex(
        "00015452414e53464f524d0000004465766963654e616d6500000000000000000000"
        "00000000499602d40000000000000030f6dd2b8eb4df6dd2"
    )
    time_ns = read_header(published).time_ns
    ours = write_message(Message("TRANSFORM", "DeviceName", TRANSFORM, time_ns))[:HEADER_BYTES]
    # The fraction of a second has four steps to the nanosecond.
    assert ours[:34] + ours[42:] == published[:34] + published[42:]
    assert struct.unpack(">I", ours[38:42])[0] == pytest.approx(0x499602D4, abs=4)


names = st.text(st.characters(codec="ascii", exclude_characters="\0"), max_size=20)
metadata = st.dictionaries(st.text(max_size=20), st.text(max_size=40), max_size=6)
messages = st.builds(
    Message,
    type=st.from_regex(r"[A-Z][A-Z0-9_]{0,11}", fullmatch=True),
    device=names,
    content=st.binary(max_size=300),
    time_ns=st.integers(0, 2**32 * 10**9 - 1),
    version=st.just(2),
    metadata=metadata,
    number=st.integers(0, 2**32 - 1),
) | st.builds(
    Message,
    type=st.just("TRANSFORM"),
    device=names,
    content=st.binary(max_size=300),
    time_ns=st.integers(0, 2**32 * 10**9 - 1),
)


def all_of(decoder: Decoder) -> list[object]:
    found = []
    while (event := decoder.take()) is not None:
        found.append(event)
    return found


@given(st.lists(messages, max_size=5), st.lists(st.integers(0, 2000), max_size=10))
def test_what_is_written_is_read_however_it_is_cut(given_messages, cuts):
    data = b"".join(map(write_message, given_messages))
    decoder = Decoder(Everything())
    found: list[object] = []
    ends = sorted({min(cut, len(data)) for cut in cuts} | {len(data)})
    for begin, end in zip([0, *ends], ends, strict=False):
        decoder.feed(data[begin:end])
        found += all_of(decoder)
    assert found == given_messages
    assert not decoder.partial


@given(messages, st.data())
def test_mutated_messages_raise_nothing_but_the_codecs_error(message, data):
    mutated = bytearray(write_message(message))
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(mutated) - 1))
        mutated[at] ^= data.draw(st.integers(1, 255))
    decoder = Decoder(Everything())
    decoder.feed(bytes(mutated))
    with contextlib.suppress(BadMessage):
        for event in all_of(decoder):
            assert isinstance(event, Message | Damaged)
            # A checksum of 64 bits finds all of so few changes of the body; the header, and the
            # version in it by which the body is read, it does not protect.
            if isinstance(event, Message) and event.version == message.version:
                assert event.content == message.content


@given(message=messages, at=st.integers(0, 10**6), by=st.integers(1, 255))
def test_a_damaged_body_is_told_and_the_next_message_read(message, at, by):
    data = bytearray(write_message(message))
    if len(data) == HEADER_BYTES:
        return
    data[HEADER_BYTES + at % (len(data) - HEADER_BYTES)] ^= by
    decoder = Decoder(Everything())
    decoder.feed(bytes(data) + write_message(message))
    damaged, whole = all_of(decoder)
    assert isinstance(damaged, Damaged)
    assert isinstance(damaged.reason, WrongChecksum)
    assert whole == message


@given(st.binary(max_size=500))
def test_random_bytes(data):
    decoder = Decoder(Everything(), max_body_bytes=1000)
    decoder.feed(data)
    with contextlib.suppress(BadMessage):
        all_of(decoder)
    assert len(decoder._buffer) <= len(data)


@given(st.integers(1, 255), st.binary(max_size=400))
def test_consistent_garbage_in_the_body(version, body):
    """Right checksum, nonsense in it: sizes of extended header and metadata that do not fit."""
    header = struct.pack(
        ">H12s20sIIQQ", 2, b"TRANSFORM", b"x", 0, 0, len(body), crc64.ecma_182(body)
    )
    with contextlib.suppress(BadMessage):
        read_body(read_header(header), body)


@pytest.mark.parametrize("sizes", [(11, 0, 0), (101, 0, 0), (12, 89, 0), (12, 0, 2**31)])
def test_parts_that_do_not_fit_in_the_body(sizes):
    body = struct.pack(">HHII", *sizes, 1).ljust(100, b"x")
    header = struct.pack(
        ">H12s20sIIQQ", 2, b"TRANSFORM", b"x", 0, 0, len(body), crc64.ecma_182(body)
    )
    with pytest.raises(BadMessage, match="do not fit"):
        read_body(read_header(header), body)


@pytest.mark.parametrize(
    ("head", "values"),
    [
        (struct.pack(">HHHI", 1, 3, 3, 6), b"Key12345"),
        (struct.pack(">HHHI", 1, 9, 3, 0), b"Key12345"),
        (struct.pack(">HHHI", 2, 3, 3, 5), b"Key12345"),
        (struct.pack(">HHHI", 1, 3, 99, 5), b"Key12345"),
        (struct.pack(">HHHI", 1, 3, 3, 5), b"Key\xff2345"),
        (b"\0", b""),
    ],
)
def test_metadata_that_are_none(head, values):
    body = struct.pack(">HHII", 12, len(head), len(values), 1) + head + values
    header = struct.pack(
        ">H12s20sIIQQ", 2, b"TRANSFORM", b"x", 0, 0, len(body), crc64.ecma_182(body)
    )
    with pytest.raises(BadMessage):
        read_body(read_header(header), body)


READERS = {
    "transform": read_transform, "position": read_position, "tdata": read_tdata,
    "qtdata": read_qtdata, "points": read_points, "status": read_status, "string": read_string,
    "command": read_command, "capability": read_capability,
    "start": lambda content: read_start("STT_TDATA", content),
}  # fmt: skip


@pytest.mark.parametrize("reader", READERS.values(), ids=READERS)
@settings(max_examples=40)
@given(content=st.binary(max_size=400))
def test_contents_of_any_bytes(reader, content):
    with contextlib.suppress(BadMessage):
        reader(content)


@pytest.mark.parametrize("reader", READERS.values(), ids=READERS)
def test_contents_of_no_size(reader):
    with pytest.raises(BadMessage, match="bytes"):
        reader(b"123456789")


def test_skipped_bodies_are_not_kept():
    large = Message("IMAGE", "x", bytes(3_000_000))
    decoder = Decoder({"STATUS"}, max_body_bytes=1000)
    data = write_message(large) + write_message(Message("STATUS", "x", b"1"))
    most, found = 0, []
    for at in range(0, len(data), 10_000):
        decoder.feed(data[at : at + 10_000])
        found += all_of(decoder)
        most = max(most, len(decoder._buffer))
    assert most <= 10_000
    skipped, status = found
    assert isinstance(skipped, Skipped)
    assert isinstance(status, Message)


def test_too_large_a_body_of_a_type_that_is_read():
    header = struct.pack(">H12s20sIIQQ", 1, b"STATUS", b"x", 0, 0, 2**63, 0)
    decoder = Decoder({"STATUS"})
    decoder.feed(header + b"more")
    with pytest.raises(BadMessage, match=str(2**63)):
        decoder.take()
    with pytest.raises(BadMessage):
        decoder.take()
    assert len(decoder._buffer) == 0


@pytest.mark.parametrize("wrong", [
    Message("MUCH_TOO_LONG_A_TYPE"), Message("STATUS", "a name of twenty-one."),
    Message("STATUS", time_ns=2**32 * 10**9), Message("STATUS", time_ns=-1),
    Message("STATUS", version=2, metadata={"k" * 65536: ""}),
    Message("STATUS", version=2, metadata={str(one): "" for one in range(8192)}),
])  # fmt: skip
def test_what_does_not_fit_is_refused(wrong):
    with pytest.raises(BadMessage):
        write_message(wrong)


coordinates = st.floats(-1e6, 1e6, width=32)
vectors = st.tuples(coordinates, coordinates, coordinates)


@given(vectors, vectors)
def test_poses_keep_what_float32_holds(turn, translation):
    rotation = rotation_matrix(np.array(turn) * 1e-6)
    found, moved = read_transform(write_transform(rotation, np.array(translation)))
    assert np.array_equal(found, rotation.astype(np.float32))
    assert moved.tolist() == list(translation)
    (tool,) = read_tdata(write_tracking("TDATA", [("a", rotation, np.array(translation))]))
    assert np.array_equal(tool.rotation, found)
    ((name, place, quaternion),) = read_qtdata(
        write_tracking("QTDATA", [("a", rotation, np.array(translation))])
    )
    assert (name, place.tolist()) == ("a", list(translation))
    x, y, z, w = quaternion
    turned = np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip
    assert turned == pytest.approx(rotation, abs=1e-6)


@given(st.text(max_size=100), st.text(max_size=100))
def test_texts(name, text):
    assert read_string(write_string(text)) == text
    command = read_command(write_command(Command(7, "Version", text)))
    assert command == Command(7, "Version", text)
    clean = name.replace("\0", "")
    status = read_status(write_status(3, "x", clean))
    assert status.text == clean


def test_starts_and_points():
    assert read_start("STT_TDATA", write_start(StartStream(50, "Tracker"))) == StartStream(
        50, "Tracker"
    )
    assert read_start("STT_TDATA", b"") == StartStream()
    assert read_start("STT_TDATA", struct.pack(">I", 20)) == StartStream(20)
    long = Point("ü" * 40, "Landmark", (1.0, 2.0, 3.0), owner="x" * 30)
    (found,) = read_points(write_points([long]))
    assert found.name == "ü" * 32
    assert found.owner == "x" * 20


def test_a_long_string_is_cut_to_what_its_format_holds():
    assert read_string(write_string("x" * 70_000)) == "x" * 65_535


def packed(message: pyigtl.MessageBase, version: int) -> bytes:
    message.header_version = version
    message.metadata = {"Key": "value", "Other": "2"} if version == 2 else {}
    message.message_id = 17 if version == 2 else 0
    return message.pack()


@pytest.mark.parametrize("version", [1, 2])
def test_bytes_are_those_of_pyigtl(version):
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation_matrix(np.array([0.3, -0.2, 0.9])), [1.5, -2.25, 1e3]
    theirs = {
        "TRANSFORM": pyigtl.TransformMessage(matrix, 12.5, "probeToTracker"),
        "STRING": pyigtl.StringMessage("some text", 12.5, "probeToTracker"),
        "POINT": pyigtl.PointMessage(
            [1.0, 2.0, 3.0], ["p"], [[1, 2, 3, 4]], [5.0], ["Marker"], ["Tracker"],
            timestamp=12.5, device_name="probeToTracker",
        ),
    }  # fmt: skip
    ours = {
        "TRANSFORM": write_transform(matrix[:3, :3], matrix[:3, 3]),
        "STRING": write_string("some text"),
        "POINT": write_points([
            Point("p", "Marker", (1.0, 2.0, 3.0), (1, 2, 3, 4), 5.0, "Tracker")
        ]),
    }  # fmt: skip
    more = {"metadata": {"Key": "value", "Other": "2"}, "number": 17} if version == 2 else {}
    for kind, content in ours.items():
        message = Message(kind, "probeToTracker", content, 12_500_000_000, version, **more)
        assert write_message(message) == packed(theirs[kind], version)
        decoder = Decoder(Everything())
        decoder.feed(packed(theirs[kind], version))
        assert decoder.take() == message
