"""Stream messages: what a client receives, encoded as MessagePack or JSON."""

import json
from collections.abc import Iterator
from math import isfinite
from typing import Any, Final, Literal, get_args

import msgpack

from compute.flags import flag_names
from hardware.driver import DeviceDescription
from service.live.batch import FrameBatch
from service.live.peak_finding import peak_method

Content = Literal["points", "peaks"]
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


def frame_messages(batch: FrameBatch, content: frozenset[Content]) -> Iterator[dict[str, Any]]:
    """Yield one message for each frame of a batch, with the chosen content.

    A point has the fields of ``PointEstimate`` and its marker; a peak those of ``Peak``,
    with None where a value is not a number.
    """
    starts = batch.owner.searchsorted(range(len(batch.frames) + 1)).tolist()
    names = batch.sensor_names
    points = batch.points.estimates(names) if "points" in content else ()
    for index, frame in enumerate(batch.frames):
        message: dict[str, Any] = {
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
        if "points" in content:
            message["points"] = [
                {"marker": frame.marker, **vars(point)}
                for point in points[starts[index] : starts[index + 1]]
            ]
        if "peaks" in content:
            first = index * len(names)
            message["peaks"] = [
                {**vars(peak), "reduced_chi2": _number(peak.reduced_chi2)}
                for sensor, name in enumerate(names)
                for peak in batch.peaks.peaks(first + sensor, name)
            ]
        yield message


def _number(value: float) -> float | None:
    """Return None for what is not a number, which JSON has no word for."""
    return value if isfinite(value) else None


def status_message(device_id: str, state: str, reason: str | None) -> dict[str, Any]:
    """Return the message that tells of a change of the device's state."""
    return {"type": "status", "device": device_id, "state": state, "reason": reason}


def describe_message(description: DeviceDescription) -> dict[str, Any]:
    """Return what a client needs to know of a running device, for hello and status messages."""
    return {
        "sensors": [sensor.name for sensor in description.sensors],
        "frame_rate_hz": description.frame_rate_hz,
        "markers": description.markers,
        "readout": description.readout,
        "method": peak_method(description),
    }


def missed_message(device_id: str, messages: int) -> dict[str, Any]:
    """Return the message that tells a slow client how many messages it did not get."""
    return {"type": "missed", "device": device_id, "messages": messages}
