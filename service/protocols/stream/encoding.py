"""Stream messages: what a client receives, encoded as MessagePack or JSON."""

import json
from collections.abc import Iterator
from functools import lru_cache
from math import isfinite
from typing import Any, Final, Literal, cast, get_args

import msgpack

from compute.flags import flag_names
from compute.reconstruction.point_batch import PointFlag
from compute.signal.peaks import PeakFlag
from hardware.driver import DeviceDescription
from service.pipeline.beam_hold_state import hold_part
from service.pipeline.detection_stage import peak_method
from service.protocols.stream.stream_batch import StreamBatch
from service.protocols.stream.tracking_messages import tool_pose_messages, track_messages

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

    A point has the fields of ``PointEstimate`` and its marker; a peak those of ``Peak``,
    with None where a value is not a number.

    Args:
        batch: F frames.
        content: what each message holds beside the frame itself.
        first: the first frame wanted, from 0.
        last: the frame after the last one wanted; None: to the end.
    """
    frames = batch.frames[first:last]
    messages: list[dict[str, Any]] = [
        {
            "type": "frame",
            "device": batch.device_id,
            "sequence": frame.sequence,
            "exposure_ns": frame.exposure_host_ns,
            "device_ns": frame.exposure_device_ns,
            "marker": frame.marker,
            "calibration": batch.calibration_id,
            "table": batch.table_id,
            "flags": flag_names(frame.flags),
        }
        for frame in frames
    ]
    if "points" in content:
        for message, points in zip(messages, _points(batch, first, len(frames)), strict=True):
            message["points"] = points
    if "peaks" in content:
        for message, peaks in zip(messages, _peaks(batch, first, len(frames)), strict=True):
            message["peaks"] = peaks
    if "tracks" in content:
        for message, tracks in zip(
            messages, track_messages(batch.motion, first, len(frames)), strict=True
        ):
            message["tracks"] = tracks
    if "tools" in content:
        for message, tools in zip(
            messages, tool_pose_messages(batch.motion, first, len(frames)), strict=True
        ):
            message["tools"] = tools
    if "holds" in content:
        for index, message in enumerate(messages, first):
            message["holds"] = [hold_part(now) for now in batch.holds[index]] if batch.holds else []
    return messages


def _points(batch: StreamBatch, first: int, count: int) -> Iterator[list[dict[str, Any]]]:
    starts = batch.owner.searchsorted(range(first, first + count + 1)).tolist()
    begin = starts[0]
    own = batch.points.part(begin, starts[-1])
    # Straight from the arrays: at thousands of frames a second, values in between cost too much.
    rows = list(
        zip(
            own.position_mm.tolist(),
            own.covariance_mm2.tolist(),
            own.residual_sigma().tolist(),
            own.used.tolist(),
            own.flags.tolist(),
            strict=True,
        )
    )
    for index in range(count):
        marker = batch.frames[first + index].marker
        yield [
            {
                "marker": marker,
                "position_mm": position if isfinite(position[0]) else None,
                "covariance_mm2": covariance if isfinite(position[0]) else None,
                "residual_sigma": _number(residual),
                "sensors": _used(batch.sensor_names, tuple(used)),
                "flags": _point_flags(flags),
            }
            for position, covariance, residual, used, flags in rows[
                starts[index] - begin : starts[index + 1] - begin
            ]
        ]


@lru_cache(maxsize=4096)
def _used(names: tuple[str, ...], used: tuple[bool, ...]) -> tuple[str, ...]:
    return tuple(name for name, use in zip(names, used, strict=True) if use)


def _peaks(batch: StreamBatch, first: int, count: int) -> Iterator[list[dict[str, Any]]]:
    names = batch.sensor_names
    lines = batch.peaks.start[first * len(names) : (first + count) * len(names) + 1].tolist()
    begin, end = (lines[0], lines[-1]) if lines else (0, 0)
    rows = list(
        zip(
            *batch.peaks.values[:, begin:end].tolist(),
            batch.peaks.flags[begin:end].tolist(),
            strict=True,
        )
    )
    for index in range(count):
        yield [
            {
                "sensor": name,
                "position_px": position,
                "sigma_px": sigma,
                "amplitude": amplitude,
                "width_px": width,
                "reduced_chi2": _number(chi2),
                "flags": _peak_flags(flags),
            }
            for line, name in enumerate(names, index * len(names))
            for position, sigma, amplitude, width, chi2, flags in rows[
                lines[line] - begin : lines[line + 1] - begin
            ]
        ]


@lru_cache
def _point_flags(flags: int) -> tuple[str, ...]:
    return flag_names(PointFlag(flags))


@lru_cache
def _peak_flags(flags: int) -> tuple[str, ...]:
    return flag_names(PeakFlag(flags))


def _number(value: float) -> float | None:
    """Return None for what is not a number, which JSON has no word for."""
    return value if isfinite(value) else None


def status_message(
    device_id: str, state: str, reason: str | None, link: str | None = None
) -> dict[str, Any]:
    """Return the message that tells of a change of the device's state, or of its link's."""
    return {"type": "status", "device": device_id, "state": state, "reason": reason, "link": link}


def describe_message(description: DeviceDescription) -> dict[str, Any]:
    """Return what a client needs to know of a running device, for hello and status messages."""
    return {
        "sensors": [sensor.name for sensor in description.sensors],
        "frame_rate_hz": description.frame_rate_hz,
        "markers": description.markers,
        "readout": description.readout,
        "method": peak_method(description),
    }


def missed_message(device_id: str, messages: int, first: int) -> dict[str, Any]:
    """Return the message that tells a slow client how many messages it lacks, from which on."""
    return {"type": "missed", "device": device_id, "messages": messages, "first": first}
