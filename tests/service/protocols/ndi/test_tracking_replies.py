"""TX and BX as a driver takes them apart."""

import struct
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from compute.pose.rigid_body import PoseStatus, ToolPose
from service.protocols.ndi.command import ReplyOption
from service.protocols.ndi.port_handles import PortHandle
from service.protocols.ndi.tracking import (
    MAX_MM,
    MAX_UNIT,
    HandleState,
    ToolReport,
    report,
    tracking_binary,
    tracking_text,
)
from tests.service.protocols.ndi.fake_poses import pose

OPTIONS = st.sets(st.sampled_from(list(ReplyOption))).map(
    lambda chosen: ReplyOption(sum(int(one) for one in chosen))
)


@st.composite
def reports(draw: st.DrawFn) -> ToolReport:
    port = PortHandle(
        draw(st.integers(1, 24)), 1, "probe", initialised=True, enabled=draw(st.booleans())
    )
    seed = draw(st.integers(0, 1000))
    status = draw(st.sampled_from(PoseStatus))
    found = draw(st.sampled_from([None, pose("probe", status, seed)]))
    count = draw(st.integers(0, 25))
    markers = np.random.default_rng(seed).uniform(-50.0, 50.0, (count, 3)) if count else None
    frame = draw(st.integers(0, 2**32 - 1))
    outside = draw(st.booleans())
    return report(port, found, frame, out_of_volume=outside, markers_mm=markers)


class Text:
    """Takes a reply to TX apart, character by character."""

    def __init__(self, text: str) -> None:
        self.text = text

    def take(self, count: int) -> str:
        taken, self.text = self.text[:count], self.text[count:]
        assert len(taken) == count
        return taken

    def word(self, *words: str) -> str | None:
        for word in words:
            if self.text.startswith(word):
                return self.take(len(word))
        return None

    def numbers(self, count: int, width: int, decimals: int) -> list[float]:
        return [int(self.take(width)) * 10.0**-decimals for _ in range(count)]


@settings(max_examples=50)
@given(st.lists(reports(), max_size=24), st.integers(0, 0xFFFF), OPTIONS)
def test_text_is_read_back(given_: list[ToolReport], system: int, options: ReplyOption):
    text = Text(tracking_text(given_, system, options))
    assert int(text.take(2), 16) == len(given_)
    for one in given_:
        assert int(text.take(2), 16) == one.handle
        if ReplyOption.TRANSFORMS in options:
            word = text.word("MISSING", "DISABLED")
            assert word == (None if one.quaternion else one.state.name)
            if one.quaternion is not None and one.translation_mm is not None:
                assert text.numbers(4, 6, 4) == pytest.approx(one.quaternion, abs=0.51e-4)
                assert text.numbers(3, 7, 2) == pytest.approx(one.translation_mm, abs=0.51e-2)
                assert text.numbers(1, 6, 4) == pytest.approx([one.error_mm], abs=0.51e-4)
            assert int(text.take(8), 16) == one.port_status
            assert int(text.take(8), 16) == one.frame
        if ReplyOption.INFORMATION in options:
            assert int(text.take(2), 16) == one.information
            assert text.take(20).count("3") == min(one.markers_used, 20)
        if ReplyOption.SINGLE_STRAY in options:
            assert text.word("MISSING", "DISABLED")
        if ReplyOption.MARKERS in options:
            count = int(text.take(2), 16)
            assert count == len(one.markers_mm)
            text.take((count + 3) // 4)
            for place in one.markers_mm:
                assert text.numbers(3, 7, 2) == pytest.approx(place, abs=0.51e-2)
        assert text.take(1) == "\n"
    if ReplyOption.STRAYS in options:
        assert text.take(2) == "00"
    assert int(text.take(4), 16) == system
    assert text.text == ""


@settings(max_examples=50)
@given(st.lists(reports(), max_size=24), st.integers(0, 0xFFFF), OPTIONS)
def test_binary_is_read_back(given_: list[ToolReport], system: int, options: ReplyOption):
    data = tracking_binary(given_, system, options)
    place = 0

    def take(form: str) -> tuple[Any, ...]:
        nonlocal place
        found = struct.unpack_from("<" + form, data, place)
        place += struct.calcsize("<" + form)
        return found

    assert take("B") == (len(given_),)
    for one in given_:
        assert take("BB") == (one.handle, one.state)
        if one.state is HandleState.DISABLED:
            continue
        if ReplyOption.TRANSFORMS in options:
            if one.quaternion is not None and one.translation_mm is not None:
                expected = (*one.quaternion, *one.translation_mm, one.error_mm)
                assert take("8f") == pytest.approx(expected, rel=1e-6, abs=1e-6)
            assert take("II") == (one.port_status, one.frame)
        if ReplyOption.INFORMATION in options:
            assert take("B") == (one.information,)
            markers = b"".join(take("10c"))
            assert markers.hex().count("3") == min(one.markers_used, 20)
        if ReplyOption.SINGLE_STRAY in options:
            assert take("B") == (0,)
        if ReplyOption.MARKERS in options:
            assert take("B") == (len(one.markers_mm),)
            take(f"{-(-len(one.markers_mm) // 8)}s")
            for marker in one.markers_mm:
                assert take("3f") == pytest.approx(marker, rel=1e-6)
    if ReplyOption.STRAYS in options:
        assert take("B") == (0,)
    assert take("H") == (system,)
    assert place == len(data)


def of(found: ToolPose | None, *, out_of_volume: bool = False, enabled: bool = True) -> ToolReport:
    port = PortHandle(1, 1, "probe", initialised=True, enabled=enabled)
    return report(port, found, 5, out_of_volume=out_of_volume)


@pytest.mark.parametrize(
    ("status", "state", "port_status", "information"),
    [
        (PoseStatus.OK, HandleState.VALID, 0x31, 0x00),
        (PoseStatus.MISSING, HandleState.MISSING, 0x31, 0x02),
        (PoseStatus.OUT_OF_VIEW, HandleState.MISSING, 0x31, 0x02),
        (PoseStatus.OUT_OF_VOLUME, HandleState.MISSING, 0x71, 0x00),
        (PoseStatus.INVALID, HandleState.MISSING, 0x31, 0x01),
        (PoseStatus.HIGH_ERROR, HandleState.MISSING, 0x31, 0x01),
        (PoseStatus.UNKNOWN, HandleState.MISSING, 0x31, 0x00),
    ],
)
def test_only_good_poses_are_given(
    status: PoseStatus, state: HandleState, port_status: int, information: int
):
    found = of(pose("probe", status))
    assert (found.state, found.port_status, found.information) == (state, port_status, information)
    assert (found.quaternion is None) == (state is not HandleState.VALID)
    assert of(pose("probe", status), enabled=False).state is HandleState.DISABLED


def test_outside_of_the_volume_only_for_who_asks():
    found = of(pose("probe", PoseStatus.OUT_OF_VOLUME), out_of_volume=True)
    assert found.state is HandleState.VALID
    assert found.port_status == 0x71
    high = of(pose("probe", PoseStatus.HIGH_ERROR), out_of_volume=True)
    assert high.state is HandleState.MISSING


def test_no_pose_at_all():
    assert of(None).state is HandleState.MISSING


def test_the_quaternion_turns_as_the_rotation_does():
    given_ = pose("probe", seed=4)
    quaternion = of(given_).quaternion
    assert quaternion is not None
    assert quaternion[0] >= 0.0
    turned = Rotation.from_quat(np.array(quaternion), scalar_first=True).as_matrix()
    assert given_.rotation is not None
    assert np.allclose(turned, given_.rotation, atol=1e-12)


@pytest.mark.parametrize("far", [MAX_MM + 0.02, np.inf, np.nan])
def test_a_place_that_cannot_be_written_is_outside(far: float):
    found = of(pose("probe", translation_mm=np.array([0.0, far, 0.0])), out_of_volume=True)
    assert found.state is HandleState.MISSING
    assert found.port_status & 0x40
    at_the_edge = of(pose("probe", translation_mm=np.array([0.0, -MAX_MM, 0.0])))
    assert "-999999" in tracking_text([at_the_edge], 0, ReplyOption.TRANSFORMS)


@pytest.mark.parametrize(
    ("changed", "expected"),
    [
        ({}, np.sqrt(0.14)),
        ({"residual_sigma": 2.0}, 2.0 * np.sqrt(0.14)),
        ({"residual_sigma": None}, np.sqrt(0.14)),
        ({"covariance": None}, MAX_UNIT),
        ({"covariance": np.eye(6) * 1e6}, MAX_UNIT),
        ({"covariance": np.full((6, 6), np.nan)}, MAX_UNIT),
    ],
)
def test_the_error(changed: dict[str, Any], expected: float):
    assert of(pose("probe", **changed)).error_mm == pytest.approx(expected)


def test_markers_where_the_pose_puts_them():
    given_ = pose("probe", seed=5)
    markers = np.array([[0.0, 0.0, 0.0], [10.0, 0.0, 0.0], [0.0, 20.0, 5.0]])
    port = PortHandle(1, 1, "probe", initialised=True, enabled=True)
    found = report(port, given_, 0, out_of_volume=False, markers_mm=markers)
    assert given_.rotation is not None
    assert given_.translation_mm is not None
    expected = [given_.rotation @ one + given_.translation_mm for one in markers]
    assert np.allclose(found.markers_mm, expected)
