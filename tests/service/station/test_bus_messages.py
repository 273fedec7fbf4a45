"""Messages of the bus: batches come back to the bit; what is no message is refused."""

from collections.abc import Sequence
from dataclasses import fields, is_dataclass, replace
from datetime import UTC, datetime
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from compute.pose.beam_hold import BeamHoldCause
from compute.pose.rigid_body import PoseStatus, ToolPose
from compute.reconstruction.point_batch import PointBatch
from compute.signal.peaks import PeakBatch
from compute.tracking.track_batch import TrackBatch
from hardware.driver import DeviceDescription, SensorDescription
from hardware.line_frame import FrameFlag, LineFrame
from hardware.link import LinkCounters, LinkState
from service.pipeline.active_calibration import LiveBadPixel
from service.pipeline.device_status import DeviceStatus
from service.pipeline.frame_batch import (
    BeamEnableToken,
    BeamHoldState,
    FrameBatch,
    PoseEntry,
    TrackingResult,
)
from service.station.bus_messages import (
    BatchMessage,
    DeviceFigures,
    MessageKind,
    StationFigures,
    _read_batch,
    batch_message,
    calibration_message,
    figures_message,
    hold_message,
    poses_message,
    read_bad_pixels,
    read_description,
    read_figures,
    read_hold,
    read_poses,
    split_message,
    state_message,
)

NAMES = ("a", "b", "c", "d")
DESCRIPTION = DeviceDescription(
    "bar", tuple(SensorDescription(name, 64, 12.7) for name in NAMES), 1000.0, 12, 12.0, 30.0, 64.0,
    2, line_sigma_px=2.0, profile="bar",
)  # fmt: skip


class Tokens:
    """Knows no hold from before; remembers what was held."""

    def __init__(self) -> None:
        self.ended: list[BeamHoldState] = []

    def enabled(self, hold_id: str, revision: int, due_s: float) -> BeamEnableToken:
        token = BeamEnableToken(lambda: 0.0)
        token.due_s = due_s
        return token

    def held(self, now: BeamHoldState) -> None:
        self.ended.append(now)


def assert_same(one: Any, other: Any) -> None:
    """All members are equal, arrays in type, shape and every bit."""
    assert type(one) is type(other)
    if isinstance(one, np.ndarray):
        assert (one.dtype, one.shape) == (other.dtype, other.shape)
        assert one.tobytes() == other.tobytes()
    elif isinstance(one, BeamEnableToken):
        assert one.due_s == other.due_s
    elif is_dataclass(one):
        for member in fields(one):
            assert_same(getattr(one, member.name), getattr(other, member.name))
    elif isinstance(one, tuple):
        assert len(one) == len(other)
        for a, b in zip(one, other, strict=True):
            assert_same(a, b)
    elif isinstance(one, float) and one != one:
        assert other != other
    else:
        assert one == other


def filled(kind: Any, length: int, shapes: dict[str, tuple[int, ...]], data: st.DataObject) -> Any:
    """A batch of any bits; ``shapes`` are those of one row."""
    specimen = kind.empty(1, 1) if kind is PeakBatch else kind.empty(len(NAMES))
    return kind(
        **{
            member.name: data.draw(
                arrays(
                    getattr(specimen, member.name).dtype,
                    (length, *shapes.get(member.name, ())),
                )
            )
            for member in fields(specimen)
        }
    )


REASONS = st.one_of(st.none(), st.text(max_size=20))
NUMBERS = st.one_of(st.none(), st.floats())


def pose(data: st.DataObject) -> ToolPose:
    def array(*shape: int) -> Any:
        return data.draw(st.one_of(st.none(), arrays(np.float64, shape)))

    return ToolPose(
        data.draw(st.text(max_size=9)), data.draw(st.sampled_from(PoseStatus)), data.draw(REASONS),
        data.draw(st.integers(0, 2**63 - 1)), data.draw(st.integers(0, 2**40)),
        array(3, 3), array(3), array(6, 6), array(3), array(3, 3), data.draw(NUMBERS), 3, 12,
        array(3), array(3), 5, data.draw(NUMBERS), data.draw(NUMBERS), data.draw(NUMBERS),
    )  # fmt: skip


def hold_state(data: st.DataObject) -> BeamHoldState:
    vector = st.one_of(st.none(), st.tuples(*[st.floats(-9.0, 9.0)] * 3))
    held = data.draw(st.booleans())
    release = None if held else BeamEnableToken(lambda: 0.0)
    if release is not None:
        release.due_s = data.draw(st.floats(1.0, 1e6))
    return BeamHoldState(
        "watch", held, data.draw(st.sampled_from(BeamHoldCause)), data.draw(REASONS),
        data.draw(st.integers(0, 2**62)), 7, 8, data.draw(vector), data.draw(vector),
        data.draw(st.one_of(st.none(), st.floats(0.0, 1.0))), release,
        data.draw(st.integers(0, 2**62)),
    )  # fmt: skip


def batch_of(data: st.DataObject) -> FrameBatch:
    frames, room = data.draw(st.integers(1, 3)), data.draw(st.integers(0, 3))
    points, tracks = data.draw(st.integers(0, 4)), data.draw(st.integers(0, 3))
    scans = frames * len(NAMES)
    row = dict.fromkeys(
        ("position_px", "sigma_px", "amplitude", "width_px", "flags", "reduced_chi2"), (room,)
    )
    peaks = filled(PeakBatch, scans, row | {"covariance_px2": (room, 3)}, data)
    found = filled(
        PointBatch, points, {"position_mm": (3,), "covariance_mm2": (3, 3), "used": (4,)}, data
    )
    triple = dict.fromkeys(("position_mm", "velocity_mm_s", "acceleration_mm_s2"), (3,))
    motion = None
    if data.draw(st.booleans()):
        poses = tuple(pose(data) for _ in range(data.draw(st.integers(0, 2))))
        motion = TrackingResult(
            filled(TrackBatch, tracks, triple | {"covariance": (9, 9), "peaks": (4,)}, data),
            data.draw(arrays(np.intp, tracks)), poses, data.draw(arrays(np.intp, len(poses))),
        )  # fmt: skip
    return FrameBatch(
        "sim", NAMES, data.draw(REASONS), data.draw(REASONS),
        tuple(
            LineFrame("sim", data.draw(st.integers(0, 2**40)), number,
                      data.draw(st.integers(0, 2**63)),
                      data.draw(st.one_of(st.none(), st.integers(0, 9))),
                      data.draw(arrays(np.uint16, (4, 5))), FrameFlag(data.draw(st.integers(0, 3))))
            for number in range(frames)
        ),
        peaks, found, data.draw(arrays(np.intp, points)), motion,
        tuple((hold_state(data),) for _ in range(frames)) if data.draw(st.booleans()) else (),
        data.draw(REASONS),
    )  # fmt: skip


def read(message: bytes, tokens: Tokens | None = None) -> FrameBatch:
    return batch_of_message(message, tokens).read()


def batch_of_message(message: bytes, tokens: Tokens | None = None) -> BatchMessage:
    kind, header, end = split_message(message)
    assert kind is MessageKind.BATCH
    return BatchMessage(message, header, end, tokens or Tokens())


@settings(deadline=None, max_examples=60)
@given(st.data())
def test_any_batch_comes_back_to_the_bit(data: st.DataObject) -> None:
    batch, tokens = batch_of(data), Tokens()
    assert_same(read(batch_message(batch, pixels=True), tokens), batch)
    held = [now for after in batch.holds for now in after if now.held]
    assert [now.revision for now in tokens.ended] == [now.revision for now in held]


@settings(deadline=None, max_examples=40)
@given(st.data())
def test_newest_poses_come_back_to_the_bit(data: st.DataObject) -> None:
    poses = {one.tool: one for one in (pose(data) for _ in range(data.draw(st.integers(0, 3))))}
    entry = PoseEntry(
        "sim", data.draw(st.integers(0, 2**40)), data.draw(st.integers(0, 2**63 - 1)), poses,
        data.draw(REASONS), data.draw(st.floats(0.0, 1e5)), data.draw(REASONS),
    )  # fmt: skip
    kind, header, _ = split_message(poses_message(entry))
    assert kind is MessageKind.POSES
    read_back = read_poses(header)
    assert list(read_back.poses) == list(poses)
    for name, one in poses.items():
        assert_same(read_back.poses[name], one)
    for member in fields(entry):
        if member.name not in ("poses", "arrived_s"):
            assert_same(getattr(read_back, member.name), getattr(entry, member.name))


@pytest.mark.parametrize("dropped", ["at the station", "before it is read", "after"])
@settings(deadline=None, max_examples=20)
@given(data=st.data())
def test_without_pixels_all_else_comes_back(dropped: str, data: st.DataObject) -> None:
    batch = batch_of(data)
    message = batch_of_message(batch_message(batch, pixels=dropped != "at the station"))
    assert (message.device_id, message.count) == (batch.device_id, len(batch.frames))
    assert message.first_sequence == batch.frames[0].sequence
    assert message.last_sequence == batch.frames[-1].sequence
    if dropped == "after":
        assert_same(message.read(), batch)  # shared by all who want the newest
        _read_batch.cache_clear()
    message.drop_pixels()
    found = message.read()
    assert all(frame.lines.size == 0 for frame in found.frames)
    frames = tuple(
        replace(frame, lines=there.lines)
        for frame, there in zip(found.frames, batch.frames, strict=True)
    )
    assert_same(replace(found, frames=frames), batch)


@pytest.mark.parametrize(
    "data",
    [b"", b"\x00", b"\xc1", msgpack.packb([]), msgpack.packb([99]), msgpack.packb({"a": 1}),
     msgpack.packb(["BATCH"])],
)  # fmt: skip
def test_other_bytes_are_no_message(data: bytes) -> None:
    with pytest.raises(ValueError, match="no message of the bus"):
        split_message(data)


def test_states_holds_and_calibrations_come_back() -> None:
    kind, header, _ = split_message(state_message("sim", "running", None, "silent", DESCRIPTION))
    assert kind is MessageKind.STATE
    assert header[:4] == ["sim", "running", None, "silent"]
    assert read_description(header[4]) == DESCRIPTION
    assert read_description(None) is None

    held = BeamHoldState("watch", True, BeamHoldCause.NO_DATA, "nothing", 5, revision=9)
    kind, header, _ = split_message(hold_message("sim", held, last=True))
    assert kind is MessageKind.HOLD
    assert (header[0], header[2]) == ("sim", True)
    tokens = Tokens()
    assert read_hold(header[1], tokens) == held
    assert tokens.ended == [held]

    masked = [LiveBadPixel("a", 7, "hot", datetime(2026, 5, 4, 3, 2, 1, 5, UTC))]
    kind, header, _ = split_message(calibration_message(4, 12, masked))
    assert kind is MessageKind.CALIBRATION
    assert header[:2] == [4, 12]
    assert read_bad_pixels(header[2]) == tuple(masked)


@pytest.mark.parametrize("devices", [(), ("sim",), ("sim", "other")])
def test_figures_come_back(devices: Sequence[str]) -> None:
    link = LinkState("garbled", "noise", LinkCounters(received_bytes=4, reconnects=2), 12.5, -3.0)
    status = DeviceStatus("running", None, "cal", "table", 9, 8, 7, 6, 5, link, 4, "radio")
    one = DeviceFigures(
        status, 3, DESCRIPTION, True, True, False, ((1, 2, 3), 0.5),
        (4, {"reception": 0.25, "waiting": 0.5, "computation": 1.0, "publication": 2.0}),
        {"head": ({PoseStatus.OK: 5, PoseStatus.MISSING: 1}, 77)}, {"method": "fit"},
    )  # fmt: skip
    figures = StationFigures(dict.fromkeys(devices, one), 0.125, ready=True)
    kind, header, _ = split_message(figures_message(figures))
    assert kind is MessageKind.FIGURES
    assert read_figures(header[0]) == figures
