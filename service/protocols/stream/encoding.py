"""Wire encoder: messages of the stream as MessagePack or JSON; it knows wire types only."""

import json
from typing import Any, Final, Literal, cast, get_args

import msgpack

from service.protocols.stream.stream_batch import StreamBatch

Content = Literal["points", "peaks", "tracks", "tools", "holds"]
Encoding = Literal["msgpack", "json"]
CONTENTS: Final[tuple[Content, ...]] = get_args(Content)
ENCODINGS: Final[tuple[Encoding, ...]] = get_args(Encoding)

Payload = bytes | str


def encode(message: dict[str, Any], encoding: Encoding) -> Payload:
    """Encode one message: a binary frame of MessagePack, or a text frame of JSON."""
    if encoding == "msgpack":
        packed: bytes = msgpack.packb(message)
        return packed
    return json.dumps(message, allow_nan=False, separators=(",", ":"))


def bundle(device_id: str, frames: list[Payload], encoding: Encoding) -> Payload:
    """Return one message with many frames, which are encoded already."""
    if encoding == "msgpack":
        packer = msgpack.Packer(autoreset=False)
        packer.pack_map_header(3)
        for word in ("type", "frames", "device", device_id, "frames"):
            packer.pack(word)
        packer.pack_array_header(len(frames))
        return b"".join((packer.bytes(), *cast("list[bytes]", frames)))
    head = {"type": "frames", "device": device_id}
    text = json.dumps(head, separators=(",", ":"))
    return f'{text[:-1]},"frames":[{",".join(cast("list[str]", frames))}]}}'


def frame_messages(
    batch: StreamBatch, content: frozenset[Content], first: int = 0, last: int | None = None
) -> list[dict[str, Any]]:
    """Return one message for each frame of a batch, with the chosen content.

    Args:
        batch: F frames.
        content: what each message holds beside the frame itself.
        first: the first frame wanted, from 0.
        last: the frame after the last one wanted; None: to the end.
    """
    messages = batch.headers(first, last)
    count = len(messages)
    for name, rows_of in (
        ("points", batch.point_rows),
        ("peaks", batch.peak_rows),
        ("tracks", batch.track_rows),
        ("tools", batch.tool_rows),
        ("holds", batch.hold_rows),
    ):
        if name in content:
            for message, rows in zip(messages, rows_of(first, count), strict=True):
                message[name] = rows
    return messages


def status_message(
    device_id: str, state: str, reason: str | None = None, link: str | None = None
) -> dict[str, Any]:
    """Return the message about a change of the device's state, or of its link's."""
    return {"type": "status", "device": device_id, "state": state, "reason": reason, "link": link}


def missed_message(device_id: str, messages: int, first: int) -> dict[str, Any]:
    """Return the message to a slow client: how many messages it lacks, and from which on."""
    return {"type": "missed", "device": device_id, "messages": messages, "first": first}
