"""The navigation benchmark's client reads what the server writes, and sums it up rightly."""

import struct
from urllib.parse import urlsplit

import numpy as np
import pytest

from benchmarks.baseline_transforms import running_baseline_transforms
from benchmarks.navigation import Received, _crc, _question, _taken, summed, transforms
from service.protocols.openigtlink.message import Decoder, Message, write_message


def transform(time_ns: int, version: int, number: int) -> bytes:
    content = struct.pack(">12f", 1, 4, 7, 2, 5, 8, 3, 6, 9, 10, 20, 30)
    metadata = {"TransformValid": "1", "FrameNumber": str(number)} if version > 1 else {}
    return write_message(
        Message("TRANSFORM", "probeToTracker", content, time_ns, version, metadata)
    )


@pytest.mark.parametrize("piece", [1, 7, 1000])
def test_transforms_are_read_in_any_pieces(piece: int) -> None:
    sent = b"".join(
        (
            transform(1_500_000_000, 1, 0),
            write_message(Message("STATUS", "", bytes(30), 5)),
            transform(2_500_000_001, 2, 71),
        )
    )
    waiting, found = bytearray(), []
    for place in range(0, len(sent), piece):
        waiting += sent[place : place + piece]
        found += list(_taken(waiting, 3_000_000_000))
    assert [one.device for one in found] == ["probeToTracker"] * 2
    assert [one.sequence for one in found] == [-1, 71]
    assert [one.exposure_ns for one in found] == pytest.approx([1.5e9, 2.5e9], abs=2)
    assert found[1].matrix.tolist() == [[1, 2, 3, 10], [4, 5, 6, 20], [7, 8, 9, 30]]
    assert not waiting


def test_the_question_is_one() -> None:
    decoder = Decoder({"GET_STATUS"}, 1000)
    decoder.feed(_question())
    message = decoder.take()
    assert isinstance(message, Message)
    assert (message.type, message.version) == ("GET_STATUS", 2)
    assert _crc(b"123456789") == 0x6C40DF5F0B497347  # the check value of CRC-64/ECMA-182


def test_figures() -> None:
    def received(exposed_ms: int, came_ms: int) -> Received:
        return Received("a", exposed_ms * 10**6, came_ms * 10**6, 0, np.zeros((3, 4)))

    figures = summed([received(0, 2), received(10, 13), received(5, 20)])
    assert (figures.transforms, figures.out_of_order) == (3, 1)
    assert figures.latency_ms["p50"] == pytest.approx(3.0)
    assert figures.latency_ms["max"] == pytest.approx(15.0)
    assert figures.jitter_ms["max"] == pytest.approx(12.0)
    with pytest.raises(RuntimeError, match="1 transforms"):
        summed([received(0, 1)])


def test_the_bare_server_sends_transforms_like_ours() -> None:
    with running_baseline_transforms() as url:
        address = urlsplit(url)
        assert address.hostname is not None
        assert address.port is not None
        found = list(transforms(address.hostname, address.port, 0.3))
    assert len(found) > 10
    assert summed(found).out_of_order == 0
