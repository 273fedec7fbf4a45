"""Commands: what is done, what is refused and why, and XML that means harm."""

import asyncio
from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.protocols.openigtlink.commands import (
    CommandReply,
    CommandRequest,
    Commands,
    file_name,
    read_command_request,
    reply_metadata,
    write_reply,
)
from service.protocols.openigtlink.message import CommandRefused
from service.protocols.openigtlink.snapshot import Snapshot
from service.protocols.openigtlink.transforms import MAX_TRANSFORMS, inverse_of, name_tools
from tests.service.protocols.openigtlink.test_client import FakeHost, entry

BOMB = '<!DOCTYPE x [<!ENTITY a "ha"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;">]><Command Name="&b;"/>'
OUTSIDE = (
    '<!DOCTYPE x [<!ENTITY a SYSTEM "file:///etc/passwd">]><Command Name="Version">&a;</Command>'
)
IDENTITY = "1 0 0 4 0 1 0 5 0 0 1 6 0 0 0 1"


def run(host: FakeHost, commands: Commands, name: str, **attributes: str) -> CommandReply:
    return asyncio.run(commands.run(CommandRequest(name, attributes), "10.1.2.3"))


def made(*, changes: bool = True) -> tuple[FakeHost, Commands]:
    host = FakeHost()
    snapshot = Snapshot(entry(4), name_tools(list(host.known)))
    return host, Commands(host, lambda: snapshot, changes=changes)


@pytest.mark.parametrize("text", [
    BOMB, OUTSIDE, "<Command", "<Order Name='x'/>", "<Command/>", "no xml", "\x01", "&",
    "<Command Name='a' Name='b'/>", "<a>" * 10_000,
])  # fmt: skip
def test_xml_that_is_none_of_a_command(text: str):
    with pytest.raises(CommandRefused):
        read_command_request("", text)


@given(st.text(max_size=200))
def test_any_text_is_a_command_or_refused(text):
    with suppress(CommandRefused):
        assert read_command_request("Version", text).name == "Version"


@given(st.text(max_size=60), st.text(max_size=60), st.booleans())
def test_replies_are_xml_whatever_is_in_them(name, text, done):
    from defusedxml.ElementTree import fromstring

    reply = CommandReply(done=done, message=text)
    for one in (write_reply(None, reply), write_reply(name, reply)):
        found = fromstring(one)
        assert found.tag == "CommandReply"
        assert found.attrib["Status"] == ("SUCCESS" if done else "FAIL")
    assert reply_metadata(reply)["Status"] == ("SUCCESS" if done else "FAIL")


def test_plus_has_the_same_form():
    assert write_reply("Version", CommandReply(done=True, message='a "b" <c>')) == (
        '<CommandReply Name="Version" Status="SUCCESS" Message=\'a "b" &lt;c&gt;\'></CommandReply>'
    )
    asked = read_command_request("", '<Command Name="StartRecording" OutputFilename="a.mha"/>')
    assert asked == CommandRequest(
        "StartRecording", {"Name": "StartRecording", "OutputFilename": "a.mha"}
    )


def test_what_reads():
    host, commands = made(changes=False)
    version = run(host, commands, "version")
    assert version.done
    assert version.values["IGTLHeaderVersion"] == "2"
    assert run(host, commands, "RequestChannelIds").message == "sim"
    assert run(host, commands, "RequestDeviceIds").values == {"sim": "sim"}
    found = run(host, commands, "GetTransform", TransformName="probeToTracker")
    values = [float(value) for value in found.values["probeToTracker"].split()]
    assert [values[3], values[7], values[11]] == [4.0, 5.0, -7.5]
    assert values[12:] == [0, 0, 0, 1]
    back = run(host, commands, "GetTransform", TransformName="TrackerToprobe")
    assert not back.done  # a frame behind "To" has a capital
    back = run(host, commands, "GetTransform", TransformName="TrackerToProbe")
    inverse = np.array(back.values["TrackerToProbe"].split(), float).reshape(4, 4)
    assert np.allclose(inverse @ np.reshape(values, (4, 4)), np.eye(4), atol=1e-6)
    assert "probeToTracker" in run(host, commands, "GetConfiguration").values["Transforms"]
    assert run(host, commands, "SaveConfig").done
    assert not run(host, commands, "SaveConfig", Filename="/etc/passwd").done
    assert host.audited == []


def test_changes_are_refused_and_written_down_unless_a_setting_allows_them():
    host, commands = made(changes=False)
    for name in ("StartRecording", "StopRecording", "UpdateTransform"):
        reply = run(host, commands, name, TransformName="aToB", TransformValue=IDENTITY)
        assert not reply.done
        assert "openigtlink_changes" in reply.message
    assert host.recording is None
    assert {outcome for _, outcome in host.audited} == {"refused"}
    assert len(host.audited) == 3


def test_inverses_whatever_the_capitals():
    host, commands = made()
    refused = run(
        host, commands, "UpdateTransform", TransformName="TrackerToProbe", TransformValue=IDENTITY
    )
    assert "tracked" in refused.message
    for name in ("imageToBed", "bed-2ToCt", "Bed-2ToCt"):
        run(host, commands, "UpdateTransform", TransformName=name, TransformValue=IDENTITY)
    for name in ("bedToImage", "BedToImage"):
        found = run(host, commands, "GetTransform", TransformName=name)
        assert found.values[name] == "1 0 0 -4 0 1 0 -5 0 0 1 -6 0 0 0 1"
    assert inverse_of("CtToBed-2", ["bed-2ToCt", "Bed-2ToCt"]) == "Bed-2ToCt"
    # Of two that are alike neither is taken.
    assert inverse_of("CtToBed", ["bedToCt", "bedToct"]) is None


def test_recordings():
    host, commands = made()
    assert not run(host, commands, "StopRecording").done
    long = run(host, commands, "StartRecording", CaptureDeviceId="x" * 60_000)
    assert (long.done, len(long.message) < 100) == (False, True)
    begun = run(host, commands, "StartRecording", OutputFilename="../../tmp/My scan.nrrd")
    assert begun.values == {"OutputFilename": "My-scan.h5"}
    assert host.recording == "My-scan.h5"
    assert not run(host, commands, "StartRecording").done
    assert run(host, commands, "StopRecording", CaptureDeviceId="sim").done
    assert host.audited == [
        ("openigtlink-stop-recording", "refused"),
        ("openigtlink-start-recording", "refused"),
        ("openigtlink-start-recording", "done"),
        ("openigtlink-start-recording", "refused"),
        ("openigtlink-stop-recording", "done"),
    ]


@given(st.text(max_size=300))
def test_a_file_name_is_one_of_the_folder_of_recordings(wanted):
    from re import fullmatch

    from service.api.recordings.schema import NAME_PATTERN

    try:
        name = file_name(wanted)
    except CommandRefused:
        return
    assert fullmatch(NAME_PATTERN, name)
    assert len(name) <= 100


def test_transforms():
    host, commands = made()
    set_one = run(
        host, commands, "UpdateTransform", TransformName="ProbeToTip", TransformValue=IDENTITY,
        TransformError="0.3", TransformDate="today",
    )  # fmt: skip
    assert set_one.done
    assert "WARNING" in set_one.message
    found = run(host, commands, "GetTransform", TransformName="ProbeToTip")
    assert found.values == {
        "ProbeToTip": IDENTITY, "persistent": "false", "error": "0.3", "date": "today",
    }  # fmt: skip
    inverse = run(host, commands, "GetTransform", TransformName="TipToProbe")
    assert inverse.values["TipToProbe"].split()[3::4] == ["-4", "-5", "-6", "1"]
    assert not run(host, commands, "GetTransform", TransformName="TipToNowhere").done


@pytest.mark.parametrize("attributes", [
    {}, {"TransformName": "aToB"}, {"TransformName": "a", "TransformValue": IDENTITY},
    {"TransformName": "aToB", "TransformValue": "1 2 3"},
    {"TransformName": "aToB", "TransformValue": IDENTITY.replace("4", "nan")},
    {"TransformName": "aToB", "TransformValue": IDENTITY[:-1] + "2"},
    {"TransformName": "aToB", "TransformValue": IDENTITY, "TransformError": "-1"},
    {"TransformName": "aToB", "TransformValue": IDENTITY, "TransformDate": "x" * 101},
    {"TransformName": "probeToTracker", "TransformValue": IDENTITY},
])  # fmt: skip
def test_transforms_that_cannot_be_set(attributes: dict[str, str]):
    host, commands = made()
    assert not run(host, commands, "UpdateTransform", **attributes).done


def test_only_so_many_transforms_are_kept():
    host, commands = made()
    done = [
        run(host, commands, "UpdateTransform", TransformName=f"a{number}ToB",
            TransformValue=IDENTITY).done
        for number in range(MAX_TRANSFORMS + 1)
    ]  # fmt: skip
    assert done == [True] * MAX_TRANSFORMS + [False]
    assert run(
        host, commands, "UpdateTransform", TransformName="a0ToB", TransformValue=IDENTITY
    ).done


def test_unknown_commands_are_told_what_there_is():
    host, commands = made()
    assert "GetTransform" in run(host, commands, "MakeCoffee").message


def test_a_fault_of_the_application_ends_no_connection(caplog: pytest.LogCaptureFixture):
    host, commands = made()

    async def broken() -> list[str]:
        raise RuntimeError("broken")

    host.devices = broken  # type: ignore[method-assign]
    reply = run(host, commands, "RequestDeviceIds")
    assert not reply.done
    assert "broken" in caplog.text
    assert "broken" not in reply.message
