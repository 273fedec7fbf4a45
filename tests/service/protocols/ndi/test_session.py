"""A client's conversation: what is answered in which state."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from compute.pose.rigid_body import PoseStatus
from service.protocols.ndi.client_state import Identity
from service.protocols.ndi.command import BREAK, Command, CommandReader
from service.protocols.ndi.pose_feed import PoseView
from service.protocols.ndi.session import Session
from tests.service.protocols.ndi.fake_poses import pose
from tests.service.protocols.ndi.test_command import with_crc

IDENTITY = Identity("Model", "1.2.3", "S1")


class Talk:
    """A session beside what it sees."""

    def __init__(self, *tools: str, part_numbers: Mapping[str, str] | None = None) -> None:
        self.view = PoseView()
        self.put(*tools)
        self.session = Session(IDENTITY, lambda _: self.view, part_numbers)

    def put(self, *tools: str, sequence: int = 7) -> None:
        poses = {name: pose(name, sequence=sequence) for name in tools}
        self.view = PoseView("bar", False, tuple(sorted(tools)), poses, sequence, True, 99.6)

    def __call__(self, command: str) -> str:
        (received,) = CommandReader().feed(with_crc(command))
        return self.session.answer(received)[:-5].decode()

    def upload(self, handle: str, content: bytes) -> None:
        image = content.ljust(-(-len(content) // 64) * 64, b"\0")
        for address in range(0, len(image), 64):
            block = image[address : address + 64].hex()
            assert self(f"PVWR:{handle}{address:04X}{block}") == "OKAY"

    def tracking(self) -> "Talk":
        assert self("INIT:") == "OKAY"
        for number in range(len(self.view.tools)):
            assert self(f"PINIT:{number + 1:02X}") == "OKAY"
            assert self(f"PENA:{number + 1:02X}D") == "OKAY"
        assert self("TSTART:") == "OKAY"
        return self


def test_tools_that_are_there():
    talk = Talk("probe", "ref")
    assert talk("INIT:") == "OKAY"
    assert talk("PHSR:00") == "020100102001"
    assert talk("PHSR:02") == "020100102001"
    assert talk("PHSR:01") == talk("PHSR:03") == talk("PHSR:04") == "00"
    assert talk("PINIT:01") == "OKAY"
    assert talk("PHSR:02") == "0102001"
    assert talk("PHSR:03") == "0101011"
    assert talk("PENA:01D") == "OKAY"
    assert talk("PHSR:04") == "0101031"
    assert talk("TSTART:") == "OKAY"
    # What was initialised is reported, and what was not is not.
    assert talk("TX:0001")[:4] == "0101"
    assert talk("TX:0001").endswith("0000003100000007\n0000")
    assert talk("TSTOP:") == "OKAY"
    assert talk("PDIS:01") == "OKAY"
    assert talk("TSTART:") == "OKAY"
    assert talk("TX:0001") == "0101DISABLED0000001100000007\n0000"


def test_information_of_a_tool():
    talk = Talk("probe").tracking()
    told = talk("PHINF:01")
    assert told == talk("PHINF:010001")
    assert (len(told), told[8:20].strip(), told[-2:]) == (33, "Lumiline", "31")
    assert talk("PHINF:010004") == "probe".ljust(20)
    assert talk("PHINF:010020") == "00000000000100"
    assert [len(talk(f"PHINF:01{1 << bit:04X}")) for bit in range(7)] == [33, 8, 20, 2, 2, 14, 2]
    assert len(talk("PHINF:01007F")) == 81
    assert talk("PHINF:010080") == "ERROR23"


def test_tools_that_the_client_defines():
    talk = Talk("probe", "ref", part_numbers={"8700340": "ref"})
    assert talk("INIT:") == "OKAY"
    assert talk("PHRQ:*********1****") == "03"
    assert talk("PHINF:030001") == "UNOCCUPIED"
    assert talk("PINIT:03") == "ERROR0D"
    talk.upload("03", b"8700340")
    assert talk("PHSR:02") == "03010010200103001"
    assert talk("PINIT:03") == "OKAY"
    assert talk("PHINF:030004").strip() == "ref"
    assert talk("PHINF:030020") == "00000000010000"
    assert talk("PENA:03D") == "OKAY"
    assert talk("PHF:01") == "OKAY"
    assert talk("PHRQ:*********1****") == "01"
    talk.upload("01", b"\0unknown\0" + b"x" * 100)
    assert talk("PINIT:01") == "ERROR0D"
    assert "unknown" in talk.session.state.problems[-1]
    assert "probe, ref" in talk.session.state.problems[-1]


def test_another_definition_makes_it_another_tool():
    talk = Talk("probe", "ref")
    assert talk("INIT:") == "OKAY"
    assert talk("PHRQ:*********1****") == "03"
    talk.upload("03", b"ref")
    assert talk("PINIT:03") == "OKAY"
    assert talk("PENA:03D") == "OKAY"
    talk.upload("03", b"probe")
    assert talk("PENA:03D") == "ERROR0E"
    assert talk("PINIT:03") == "OKAY"
    assert talk("PHINF:030004").strip() == "probe"


def test_a_definition_is_not_written_where_it_does_not_belong():
    talk = Talk("probe")
    assert talk("INIT:") == "OKAY"
    block = "00" * 64
    assert talk(f"PVWR:010000{block}") == "ERROR33"
    assert talk("PHRQ:*********1****") == "02"
    assert talk(f"PVWR:0207C0{block}") == "OKAY"
    assert talk(f"PVWR:0207C1{block}") == "ERROR23"
    assert talk(f"PVWR:020000{block[2:]}") == "ERROR07"
    assert talk(f"PVWR:020000{block[2:]}0G") == "ERROR23"


@pytest.mark.parametrize(
    ("command", "code"),
    [
        ("NONE:", "01"),
        ("BX2:--6d=tools", "01"),
        ("PHSR:05", "23"),
        ("PHSR:0", "07"),
        ("PINIT:09", "2B"),
        ("PINIT:XX", "08"),
        ("PINIT:", "07"),
        ("PENA:01D", "0E"),
        ("PENA:01X", "09"),
        ("PENA:01", "07"),
        ("PHF:09", "2B"),
        ("PHRQ:", "07"),
        ("LED:011S", None),
        ("LED:014S", "0A"),
        ("LED:011X", "0B"),
        ("LED:01", "07"),
        ("TX:0001", "0C"),
        ("TSTOP:", "0C"),
        ("TSTART:41", "23"),
        ("COMM:50000", None),
        ("COMM:A0000", None),
        ("COMM:90000", "23"),
        ("COMM:5000", "07"),
        ("BEEP:0", "23"),
        ("ECHO:", "03"),
        ("VER:9", "23"),
        ("SFLIST:09", "23"),
        ("IRATE:2", None),
        ("IRATE:3", "23"),
        ("VSEL:1", None),
        ("VSEL:2", "23"),
        ("RESET:2", "23"),
        ("GET:Param.Nothing", "34"),
        ("GET:Nothing*", "34"),
        ("SET:Param.Nothing=1", "34"),
        ("SET:Features.Hardware.Model=x", "39"),
        ("SET:Param.System Beeper", "07"),
        ("SET:Param.System Beeper=x", "35"),
        ("SET:Param.System Beeper=2", "36"),
        ("SET:Param.Tracking.Track Frequency=99999999999999999999", "36"),
        ("SET:Param.User.String0=" + "x" * 256, "36"),
    ],
)
def test_errors(command: str, code: str | None):
    talk = Talk("probe")
    assert talk("INIT:") == "OKAY"
    reply = talk(command)
    assert reply == f"ERROR{code}" if code else not reply.startswith("ERROR")


def test_modes():
    talk = Talk("probe")
    for command in ("PHSR:00", "TSTART:", "PENA:01D", "TX:0001", "BX:0001", "TSTOP:", "LED:011S"):
        assert talk(command) == "ERROR10"
    for command in ("VER:0", "APIREV:", "ECHO:hello", "SFLIST:00", "GET:*", "BEEP:3", "COMM:00000"):
        assert not talk(command).startswith("ERROR")
    talk.tracking()
    for command in ("TSTART:", "PINIT:01", "PENA:01D", "PDIS:01", "PHF:01", "PHRQ:*********1****"):
        assert talk(command) == "ERROR0C"
    assert talk("TX:2000") == "ERROR23"
    assert talk("TX:001") == "ERROR07"
    assert talk("TX:") == talk("TX:0001")
    assert talk("INIT:") == "OKAY"
    assert talk("TX:0001") == "ERROR0C"
    assert talk("PHSR:04") == "00"


def test_a_reset_begins_anew():
    talk = Talk("probe").tracking()
    assert talk.session.answer(BREAK) == b"RESETBE6F\r"
    assert talk("TX:0001") == "ERROR10"
    talk.tracking()
    assert talk("RESET:0") == "RESET"
    assert talk("TSTOP:") == "ERROR10"


def test_what_it_says_of_itself():
    talk = Talk("probe")
    lines = talk("VER:4").splitlines()
    assert "Freeze Tag: Model 1.2.3" in lines
    assert talk("GET:Features.Hardware.Model") == "Features.Hardware.Model=Model"
    assert talk("GET:Param.Tracking.Frame*") == "Param.Tracking.Frame Frequency=100"
    assert talk("SET:Param.User.String1=hello there") == "OKAY"
    assert talk("GET:Param.User.String1") == "Param.User.String1=hello there"
    assert talk("APIREV:") == "G.002.001"
    assert talk("SFLIST:03") == "0"
    assert talk("INIT:") == "OKAY"
    assert talk("SSTAT:0003") == "0000"


def test_several_devices_with_tools_are_not_guessed_between():
    talk = Talk()
    talk.view = PoseView(several=True)
    assert talk("INIT:") == "ERROR15"
    assert "ndi_device" in talk.session.state.problems[-1]


def test_tools_that_come_and_go():
    talk = Talk("probe").tracking()
    talk.put("probe", "ref")
    assert talk("TX:0001")[-4:] == "0040"
    assert talk("PHSR:02") == "0102001"
    assert talk("TX:0001")[-4:] == "0000"
    talk.put("ref")
    assert talk("TX:0001") == "0101MISSING0000003000000007\n0080"
    assert talk("PHSR:01") == "0101030"
    talk.put("probe", "ref")
    assert talk("TX:0001")[4] in "+-"


def test_old_poses_are_missing():
    talk = Talk("probe").tracking()
    talk.view = replace(talk.view, poses={}, fresh=False)
    assert talk("TX:0001") == "0101MISSING0000003100000007\n0008"


def test_frames_counted_from_now():
    talk = Talk("probe").tracking()
    assert talk("TSTOP:") == "OKAY"
    talk.put("probe", sequence=1000)
    assert talk("TSTART:80") == "OKAY"
    talk.put("probe", sequence=1002)
    assert talk("TX:0001")[-13:-5] == "00000002"
    talk.put("probe", sequence=5)  # the device began anew
    assert talk("TX:0001")[-13:-5] == "00000000"


def test_whether_there_would_be_anything_new():
    talk = Talk("probe").tracking()
    asks = Command("BX", "0001")
    assert not talk.session.repeats(asks)
    talk.session.answer(asks)
    assert talk.session.repeats(asks)
    assert not talk.session.repeats(Command("PHSR", ""))
    talk.put("probe", sequence=8)
    assert not talk.session.repeats(asks)


def test_no_more_handles_than_drivers_have_room_for():
    talk = Talk(*(f"tool-{number:02d}" for number in range(30)))
    assert talk("INIT:") == "OKAY"
    assert talk("PHSR:00")[:2] == f"{24:02X}"
    assert talk("PHRQ:*********1****") == "ERROR2D"
    assert talk("PHF:01") == "OKAY"
    assert talk("PHRQ:*********1****") == "01"


def test_markers_where_they_are_known():
    talk = Talk("probe").tracking()
    assert talk("TX:0008") == "010100\n0000"
    talk.view = replace(talk.view, markers=lambda _: np.zeros((4, 3)))
    told = talk("TX:0008")
    place = pose("probe").translation_mm
    assert place is not None
    assert told[4:7] == "040"
    assert int(told[7:14]) / 100 == pytest.approx(place[0], abs=0.0051)


NAMES = st.from_regex(
    "INIT|RESET|COMM|ECHO|VER|APIREV|SFLIST|GET|SET|BEEP|SSTAT|LED|PHSR|PHINF|PHRQ|PVWR|PINIT|"
    "PENA|PDIS|PHF|IRATE|VSEL|TSTART|TSTOP|TX|BX|GX",
    fullmatch=True,
)
PARAMETERS = st.one_of(
    st.sampled_from(["", "00", "01", "02", "01D", "0001", "180F", "*********1****", "0101"]),
    st.text(st.characters(max_codepoint=0x7F, exclude_characters="\r\0"), max_size=40),
    st.text("0123456789ABCDEF", min_size=134, max_size=134),
)


@given(st.lists(st.tuples(NAMES, PARAMETERS), max_size=40), st.data())
def test_no_conversation_does_harm(commands: list[tuple[str, str]], data: st.DataObject):
    """Whatever is asked in whatever order while tools come and go: each gets one reply."""
    talk = Talk("probe", "ref")
    for name, text in commands:
        present = data.draw(st.sets(st.sampled_from(["probe", "ref", "third"])))
        talk.put(*present)
        status = data.draw(st.sampled_from(PoseStatus))
        poses = {tool: pose(tool, status) for tool in present}
        talk.view = replace(talk.view, poses=poses)
        reply = talk.session.answer(Command(name, text))
        assert reply[:2] == b"\xc4\xa5" or (reply.endswith(b"\r") and reply.isascii())
        assert len(talk.session.state.ports) <= 24
    assert len(talk.session.state.problems) <= 50
