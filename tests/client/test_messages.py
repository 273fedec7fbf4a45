"""What the server encodes is what the client reads; what is no message is told."""

import contextlib
from dataclasses import fields
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from compute.pose.rigid_body import PoseStatus
from compute.pose.rigid_body import ToolPose as ServerPose
from lumiline.client.errors import UnreadableMessage, server_problem
from lumiline.client.messages import (
    DeviceState,
    Frame,
    Missed,
    Peak,
    Point,
    ToolPose,
    Track,
    UnknownMessage,
    messages_of,
)
from lumiline.client.server import Server
from lumiline.client.stream_state import StreamRequest, StreamState
from service.pipeline.frame_batch import pose_members
from service.protocols.stream.messages import bundle, encode, missed_message, state_message

HEAD: dict[str, Any] = {
    "type": "frame", "device_id": "sim", "sequence": 7, "exposure_ns": 1, "device_ns": 2,
    "marker": None, "calibration_id": None, "table_id": None, "flags": [], "n": 5,
}  # fmt: skip
HELLO: dict[str, Any] = {
    "type": "hello", "version": 1, "device_id": "sim", "content": ["points"], "mode": "lossless",
    "stream": "abc", "next": 5, "resumed": False, "sensors": ["a"], "frame_rate_hz": 50.0,
    "markers": 2, "readout": "lines", "method": "fit", "state": "running", "reason": None,
    "link": None, "calibration_id": None,
}  # fmt: skip

numbers = st.floats(-1e6, 1e6)
vectors = st.lists(numbers, min_size=3, max_size=3)


def state() -> StreamState:
    return StreamState(Server("http://host"), StreamRequest("sim", mode="lossless"))


@given(vectors, st.none() | numbers, st.sampled_from(["msgpack", "json"]))
def test_a_pose_of_the_server_is_read_whole(
    place: list[float], residual: float | None, encoding: Any
) -> None:
    pose = ServerPose(
        "probe", PoseStatus.HIGH_ERROR, "too far off", 1, 2, np.eye(3), np.array(place),
        np.eye(6), np.array(place), np.eye(3), residual, 4, 12,
    )  # fmt: skip
    (frame,) = state().decode(encode({**HEAD, "tools": [pose_members(pose)]}, encoding))
    assert isinstance(frame, Frame)
    assert frame.tools is not None
    (read,) = frame.tools
    assert (read.tool_id, read.status, read.reason) == ("probe", "HIGH_ERROR", "too far off")
    assert not read.valid
    assert read.translation_mm == read.tip_mm == tuple(place)
    assert read.rotation == ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    assert read.quaternion_wxyz == (1.0, 0.0, 0.0, 0.0)
    assert read.residual_sigma == residual
    assert (read.markers_used, read.readings_used) == (4, 12)
    assert read.velocity_mm_s is None
    # Everything that the server sends has its place.
    assert set(pose_members(pose)) == {one.name for one in fields(ToolPose)}


def test_a_track_and_a_point_have_the_members_that_the_guide_names() -> None:
    # Against the server's own messages in test_streams; here what its devices do not make.
    track = {
        "id": 3, "marker": 1, "state": "coasting", "flags": ["merged"], "position_mm": [1, 2, 3],
        "covariance_mm2": [[1, 0, 0]] * 3, "velocity_mm_s": [0, 0, 0],
        "velocity_covariance_mm2_s2": [[1, 0, 0]] * 3, "acceleration_mm_s2": None,
        "peaks": [0, None, 2], "nis": None, "dof": 0,
    }  # fmt: skip
    (frame,) = messages_of({**HEAD, "tracks": [track], "points": []})
    assert isinstance(frame, Frame)
    assert frame.tracks is not None
    assert isinstance(frame.tracks[0], Track)
    assert frame.tracks[0].peaks == (0, None, 2)
    assert frame.points == ()
    assert frame.peaks is None


@given(
    st.lists(st.integers(0, 10**12), min_size=1, max_size=20),
    st.sampled_from(["msgpack", "json"]),
)
def test_a_bundle_is_its_frames(sequences: list[int], encoding: Any) -> None:
    one_by_one = [
        encode({**HEAD, "sequence": sequence, "n": n}, encoding)
        for n, sequence in enumerate(sequences)
    ]
    together = state().decode(bundle("sim", one_by_one, encoding))
    singly = state()
    assert together == [message for payload in one_by_one for message in singly.decode(payload)]
    assert [frame.sequence for frame in together if isinstance(frame, Frame)] == sequences


def test_newer_members_and_kinds_do_no_harm() -> None:
    (frame,) = messages_of({**HEAD, "colour": "red"})
    assert isinstance(frame, Frame)
    (other,) = messages_of({"type": "weather", "n": 9, "rain": True})
    assert other == UnknownMessage("weather", {"n": 9, "rain": True})


@pytest.mark.parametrize(
    "given",
    [None, 3, [], {}, {"type": 3}, {"type": "frame"}, {"type": "frames"}, {"type": "hello"},
     {"type": "frames", "frames": [3]}, {**HEAD, "points": [3]}, {**HEAD, "peaks": [{}]}],
)  # fmt: skip
def test_what_is_no_message_is_told(given: object) -> None:
    with pytest.raises(UnreadableMessage):
        messages_of(given)


@given(st.binary(max_size=60) | st.text(max_size=60))
def test_any_payload_is_messages_or_an_error_of_the_client(payload: bytes | str) -> None:
    with contextlib.suppress(UnreadableMessage):
        assert state().decode(payload)


def test_a_program_gets_every_message_once_and_says_where_it_is() -> None:
    stream = state()
    assert "after" not in stream.url

    def numbers_of(*messages: dict[str, Any]) -> list[int]:
        taken = [one for message in messages for one in stream.decode(msgpack.packb(message))]
        return [one.n for one in taken if isinstance(one, Frame | DeviceState)]

    assert numbers_of(HELLO, {**HEAD, "n": 5}, {**HEAD, "n": 6}) == [5, 6]
    assert stream.url.endswith("stream=abc&after=6")
    # The connection was lost; the server says again what the program has.
    again = {**HELLO, "next": 6, "resumed": True}
    assert numbers_of(again, {**HEAD, "n": 6}, {**HEAD, "n": 7}) == [7]
    lost = missed_message("sim", 10, 8)
    assert stream.decode(msgpack.packb(lost)) == [Missed("sim", 10, 8)]
    assert stream.last == 17
    told = {**state_message("sim", "stopped", None), "n": 18}
    assert numbers_of(told) == [18]
    # The server was started anew: its numbers begin again, and all of them are new.
    assert numbers_of({**HELLO, "stream": "def", "next": 1}, {**HEAD, "n": 1}) == [1]
    assert "stream=def&after=1" in stream.url


@pytest.mark.parametrize(
    ("body", "code", "detail"),
    [
        (b'{"type": "/problems/busy", "detail": "wait"}', "busy", "wait"),
        (b"<html>Bad gateway</html>", "", "<html>Bad gateway</html>"),
        (b"", "", "no reason given"),
        (b"[1, 2]", "", "[1, 2]"),
        (b'{"type": 3, "title": "Odd"}', "", "Odd"),
        (b"\xff\xfe", "", "��"),
    ],
)
def test_whatever_refuses_is_a_problem(body: bytes, code: str, detail: str) -> None:
    problem = server_problem(502, body, "7")
    assert (problem.status, problem.code, problem.detail) == (502, code, detail)
    assert problem.retry_after_s == 7.0
    assert server_problem(502, body, "Wed, 21 Oct").retry_after_s is None


def test_point_and_peak_are_what_the_guide_says() -> None:
    # The stream's own tests compare the server's messages with these sets of names.
    assert {one.name for one in fields(Point)} == {
        "marker", "position_mm", "covariance_mm2", "residual_sigma",
        "external_reliability_mm", "sensors", "flags",
    }  # fmt: skip
    assert {one.name for one in fields(Peak)} == {
        "sensor", "position_px", "sigma_px", "amplitude", "width_px", "reduced_chi2", "flags",
    }  # fmt: skip
