"""Requests, answers, presence, subjects and search models: plain values, and back."""

from dataclasses import fields, is_dataclass
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from compute.errors import InvalidParameter, LumilineError
from hardware.errors import DeviceNotConnected
from service.pipeline.detection_stage import SearchModel, nominal_search_model
from service.problems.errors import SensorsChanged, StationFailed
from service.station.network.messages import (
    BadRequest,
    Presence,
    Reply,
    pack_presence,
    pack_reply,
    pack_request,
    read_presence,
    read_reply,
    read_request,
)
from service.station.network.search_models import plain_search_model, read_search_model
from service.station.network.subjects import (
    BATCH,
    STATE,
    inbox_prefix,
    split_subject,
    subject,
)
from tests.service.station.test_bus_messages import DESCRIPTION

PLAIN = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.text() | st.binary(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=8,
)


@settings(max_examples=60)
@given(st.lists(PLAIN, max_size=4), st.dictionaries(st.text(), PLAIN, max_size=3))
def test_requests_come_back(args: list[Any], members: dict[str, Any]) -> None:
    assert read_request(pack_request(args, members)) == (args, members)


@settings(max_examples=60)
@given(PLAIN, st.dictionaries(st.text(), st.integers(0, 2**60)), st.floats(0.0, 1e9))
def test_answers_come_back(result: Any, positions: dict[str, int], station_s: float) -> None:
    reply = Reply(result, None, "one", positions, station_s)
    assert read_reply(pack_reply(reply)) == reply


@pytest.mark.parametrize(
    "error",
    [
        SensorsChanged("other sensors", device_id="bar"),
        InvalidParameter("not that", sensor="left", value=3),
        DeviceNotConnected("it is not there", device_id="bar"),
    ],
)
def test_errors_are_the_same_ones_at_the_gateway(error: LumilineError) -> None:
    found = read_reply(pack_reply(Reply(None, error, "one", {}, 0.0))).error
    assert type(found) is type(error)
    assert found is not None
    assert (found.detail, found.context) == (error.detail, error.context)


def test_an_error_that_is_not_known_here_is_of_the_station() -> None:
    packed = msgpack.packb((None, ("of-tomorrow", "new", {"at": "noon"}), "one", {}, 0.0))
    found = read_reply(packed).error
    assert isinstance(found, StationFailed)
    assert found.detail == "new"


@pytest.mark.parametrize(
    "data", [b"", b"\xc1", msgpack.packb(3), msgpack.packb([1]), msgpack.packb([{}, 4, 4])]
)
def test_other_bytes_are_refused(data: bytes) -> None:
    for read in (read_request, read_reply, read_presence):
        with pytest.raises(BadRequest):
            read(data)


def test_presence_comes_back() -> None:
    presence = Presence(
        "hall-1", 77, 2, 3, 4, {"batch.bar": 9, "state": 1}, {"bar": "abc"}, "away", ending=True
    )
    assert read_presence(pack_presence(presence)) == presence


@given(
    st.from_regex(r"\A[a-z0-9]([a-z0-9-]{0,61}[a-z0-9])?\Z"),
    st.sampled_from([BATCH, STATE]),
    st.none() | st.from_regex(r"\A[a-z0-9]([a-z0-9-]{0,61}[a-z0-9])?\Z"),
)
def test_subjects_come_back(station: str, kind: str, device: str | None) -> None:
    words = () if device is None else (device,)
    assert split_subject(subject(station, kind, *words)) == (station, kind, device)


@pytest.mark.parametrize("text", ["", "lumiline.v1", "other.v1.bar.state", "lumiline.v2.bar.state"])
def test_other_subjects_are_refused(text: str) -> None:
    with pytest.raises(ValueError, match="no subject"):
        split_subject(text)


def test_answers_have_subjects_of_their_gateway() -> None:
    assert inbox_prefix("gateway", "one") == "lumiline.v1.inbox.gateway.one"


def same(one: Any, other: Any) -> bool:
    if isinstance(one, np.ndarray):
        return one.dtype == other.dtype and np.array_equal(one, other)
    if is_dataclass(one):
        return type(one) is type(other) and all(
            same(getattr(one, member.name), getattr(other, member.name)) for member in fields(one)
        )
    return bool(one == other)


def test_search_models_come_back_through_bytes() -> None:
    model = nominal_search_model(DESCRIPTION)
    found = read_search_model(msgpack.unpackb(msgpack.packb(plain_search_model(model))))
    assert isinstance(found, SearchModel)
    assert same(found, model)


@pytest.mark.parametrize("value", [None, 3, ["Popen", {"args": "ls"}], ["tuple", [1]]])
def test_what_is_no_search_model_is_refused(value: Any) -> None:
    with pytest.raises(ValueError, match="search model"):
        read_search_model(value)
