"""Tracks and tool poses in stream messages: the same in both encodings, none of them NaN."""

import json
from dataclasses import replace
from typing import Any

import msgpack
import numpy as np
import pytest

from compute.errors import InvalidParameter
from compute.pose.rigid_body import PoseStatus, ToolPose
from compute.tracking.track_batch import TrackBatch, TrackFlag, TrackState
from service.pipeline.frame_batch import FrameBatch, TrackingResult
from service.protocols.stream.message_log import StreamLog
from service.protocols.stream.messages import (
    CONTENTS,
    Content,
    Encoding,
    StreamBatch,
    encode,
)
from service.protocols.stream.query import parse_stream_request
from tests.service.api.quality.batches import strobed_batch
from tests.service.api.tools.batches import pose
from tests.service.pipeline.fake_trackers import some_tracks

MISSING = ToolPose("patient", PoseStatus.MISSING, "1 of 4 markers was seen", 0, 0)
TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def batch() -> FrameBatch:
    """Five frames: two tracks and two tools in the second, one track in the fourth."""
    seen = some_tracks(2)
    seen = replace(
        seen,
        marker=np.array([-1, 7], np.int32),
        state=np.array([TrackState.CONFIRMED, TrackState.COASTING], np.int8),
        flags=np.array([0, TrackFlag.MERGED | TrackFlag.FEW_SENSORS], np.int32),
        acceleration_mm_s2=np.array([[np.nan] * 3, [1.0, 2.0, 3.0]]),
        peaks=np.array([[0, 1, -1, 2], [-1] * 4], np.int32),
        nis=np.array([3.5, np.nan]),
        dof=np.array([3, 0], np.int32),
    )
    none = TrackBatch.empty(4)
    tools = [pose("pointer", 1, TURN, np.array([1.0, 2.0, 3.0])), MISSING]
    motion = TrackingResult.of(
        [none, seen, none, some_tracks(1, first=9), none], [[], tools, [], [MISSING], []]
    )
    return replace(strobed_batch(range(5)), motion=motion)


def messages(content: set[Content], first: int = 0, last: int | None = None) -> list[Any]:
    return StreamBatch(batch()).messages(frozenset(content), first, last)


def test_each_frame_has_its_own():
    found = messages({"tracks", "tools"})
    assert [[track["id"] for track in one["tracks"]] for one in found] == [[], [1, 2], [], [9], []]
    assert [[tool["tool_id"] for tool in one["tools"]] for one in found] == [
        [], ["pointer", "patient"], [], ["patient"], [],
    ]  # fmt: skip
    assert "points" not in found[0]
    assert messages({"tracks", "tools"}, 1, 4) == found[1:4]
    assert messages({"tracks", "tools"}, 3) == found[3:]
    assert "tools" not in messages({"tracks"})[1]


def test_a_track_as_it_is_sent():
    first, second = messages({"tracks"})[1]["tracks"]
    assert (first["marker"], first["state"], first["flags"]) == (None, "confirmed", ())
    assert (second["marker"], second["state"]) == (7, "coasting")
    assert second["flags"] == ("merged", "few-sensors")
    assert first["position_mm"] == [1.0, 0.0, 0.0]
    assert first["acceleration_mm_s2"] is None
    assert second["acceleration_mm_s2"] == [1.0, 2.0, 3.0]
    assert first["peaks"] == [0, 1, None, 2]
    assert (first["nis"], first["dof"]) == (3.5, 3)
    assert second["nis"] is None
    assert np.array(first["covariance_mm2"]).shape == (3, 3)
    assert np.array(first["velocity_covariance_mm2_s2"]).shape == (3, 3)


def test_a_pose_as_it_is_sent():
    known, lost = messages({"tools"})[1]["tools"]
    assert (known["status"], known["reason"]) == ("OK", None)
    assert known["translation_mm"] == [1.0, 2.0, 3.0]
    assert known["rotation"] == TURN.tolist()
    np.testing.assert_allclose(known["quaternion_wxyz"], np.sqrt(0.5) * np.array([1, 0, 0, 1]))
    assert np.array(known["covariance"]).shape == (6, 6)
    assert lost == {
        name: None for name in known if name not in ("markers_used", "readings_used")
    } | {
        "tool_id": "patient",
        "status": "MISSING",
        "reason": "1 of 4 markers was seen",
        "markers_used": 0,
        "readings_used": 0,
    }


@pytest.mark.parametrize("encoding", ["msgpack", "json"])
def test_both_encodings_hold_the_same(encoding: Encoding):
    for message in messages(set(CONTENTS)):
        payload = encode(message, encoding)
        read = json.loads(payload) if isinstance(payload, str) else msgpack.unpackb(payload)
        assert read == json.loads(json.dumps(message))


def test_what_is_no_number_is_null():
    wrong = replace(pose("pointer", 0, TURN, np.zeros(3)), velocity_mm_s=np.full(3, np.nan))
    wrong = replace(wrong, residual_sigma=float("inf"))
    motion = TrackingResult.of([TrackBatch.empty(4)], [[wrong]])
    given = StreamBatch(replace(strobed_batch(range(1)), motion=motion))
    (found,) = given.messages(frozenset({"tools"}))
    assert found["tools"][0]["velocity_mm_s"] is found["tools"][0]["residual_sigma"] is None
    encode(found, "json")


def test_a_device_that_is_not_tracked_has_none():
    given = StreamBatch(strobed_batch(range(2)))
    for message in given.messages(frozenset({"tracks", "tools", "points"})):
        assert message["tracks"] == message["tools"] == []
        assert len(message["points"]) == 1


def test_single_frames_and_batches_of_the_log_agree():
    log = StreamLog(100)
    log.append_batch(StreamBatch(batch()))
    variant = (frozenset[Content]({"tracks", "tools"}), "json")
    (entry,) = log.since(0, 10)
    single = [entry.payload(variant, number) for number in range(5)]  # type: ignore[arg-type]
    assert tuple(single) == entry.payloads(variant)  # type: ignore[arg-type]


def test_contents_are_asked_for_by_name():
    wanted = parse_stream_request({"device_id": "sim", "content": "tools,tracks,state"})
    assert wanted.content == {"tools", "tracks"}
    with pytest.raises(InvalidParameter, match="points, peaks, tracks, tools, holds, state"):
        parse_stream_request({"device_id": "sim", "content": "poses"})
