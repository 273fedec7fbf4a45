"""The server with clients on real sockets: what they get, unasked and asked, and when it ends."""

import asyncio
from dataclasses import replace

import numpy as np
import pytest

from compute.pose.rigid_body import PoseStatus
from service.api.tools.provenance import Provenance
from service.protocols.openigtlink.bodies import (
    Command,
    StartStream,
    StatusCode,
    read_command,
    read_string,
    write_command,
    write_string,
)
from service.protocols.openigtlink.host import Landmark, WireTool
from service.protocols.openigtlink.message import Message
from tests.service.protocols.openigtlink.readers import (
    read_capability,
    read_points,
    read_position,
    read_qtdata,
    read_status,
    read_tdata,
    read_transform,
    write_start,
)
from tests.service.protocols.openigtlink.test_client import (
    LOOPS,
    FakeHost,
    Peer,
    entry,
    pose,
    run,
    serving,
    until,
)

both_loops = pytest.mark.parametrize("loop", LOOPS)


async def frame(peer: Peer) -> tuple[Message, Message]:
    """Both transforms of the next frame."""
    probe = await peer.of("TRANSFORM", "probeToTracker")
    return probe, await peer.of("TRANSFORM", "refToTracker")


@both_loops
def test_every_frame_comes_to_every_client_unasked(loop: str):
    async def test() -> None:
        async with serving() as served:
            peers = [await served.joined() for _ in range(3)]
            for number in range(20):
                served.put(number)
                for peer in peers:
                    for message in await frame(peer):
                        assert message.version == 1
                        assert message.metadata == {}
                        # The exposure's own time, to the nanosecond.
                        assert message.time_ns == entry(number).exposure_ns
                        assert read_transform(message.content)[1][0] == number
            assert served.server.counters.frames_sent == 60

    run(test, loop)


@both_loops
def test_a_client_is_sent_version_1_until_it_has_sent_version_2(loop: str):
    async def test() -> None:
        async with serving() as served:
            old, new = await served.joined(), await served.joined()
            assert (await old.ask(Message("GET_STATUS"), "STATUS")).version == 1
            status = await new.ask(Message("GET_STATUS", version=2, number=7), "STATUS")
            assert status.version == 2
            served.put(1)
            assert (await frame(old))[0].version == 1
            message, _ = await frame(new)
            assert message.version == 2
            assert message.metadata["TransformValid"] == "1"
            assert message.metadata["FrameNumber"] == "1"
            # It goes on so, also when it sends version 1 again.
            assert (await new.ask(Message("GET_STATUS"), "STATUS")).version == 2

    run(test, loop)


def test_a_lost_tool_is_withheld_and_told_by_status():
    async def test() -> None:
        async with serving() as served:
            peer = await served.joined()
            served.put(0)
            await frame(peer)
            for number in (1, 2):
                served.put(number, [pose("probe", number, PoseStatus.MISSING), pose("ref", number)])
            status = await peer.message()
            assert (status.type, status.device) == ("STATUS", "probeToTracker")
            told = read_status(status.content)
            assert (told.code, told.name, told.text) == (16, "MISSING", "probe is MISSING")
            found = [await peer.message() for _ in range(2)]
            # Told once, and nothing of it until it is seen again.
            assert [one.device for one in found] == ["refToTracker"] * 2
            served.put(3)
            again = await peer.message()
            assert read_status(again.content).code == StatusCode.OK
            assert (await peer.message()).device == "probeToTracker"
            # Who comes later is told, too.
            served.put(4, [pose("probe", 4, PoseStatus.INVALID), pose("ref", 4)])
            late = await served.joined()
            assert read_status((await late.of("STATUS", "probeToTracker")).content).code == 2
            assert served.server.counters.poses_withheld >= 3

    run(test)


def test_marked_poses_go_to_clients_of_version_2_where_a_setting_says_so():
    async def test() -> None:
        async with serving(send_invalid=True) as served:
            old, new = await served.joined(), await served.joined()
            await new.ask(Message("GET_STATUS", version=2), "STATUS")
            served.put(0, [pose("probe", 0, PoseStatus.HIGH_ERROR), pose("ref", 0)])
            marked = await new.of("TRANSFORM")
            assert marked.device == "probeToTracker"
            assert marked.metadata["TransformValid"] == "0"
            assert (await old.of("TRANSFORM")).device == "refToTracker"

    run(test)


@pytest.mark.parametrize("kind", ["TDATA", "QTDATA"])
def test_tracking_data_begins_and_stops(kind: str):
    async def test() -> None:
        async with serving() as served:
            peer = await served.joined()
            start = Message(f"STT_{kind}", "nav", write_start(StartStream(0, "Tracker")), version=2)
            result = await peer.ask(start, f"RTS_{kind}")
            assert (result.content, result.device) == (b"\0", "nav")
            served.put(5, [pose("probe", 5), pose("ref", 5, PoseStatus.MISSING)])
            message = await peer.of(kind)
            assert (message.device, message.time_ns) == ("nav", entry(5).exposure_ns)
            if kind == "TDATA":
                ((name, place),) = [
                    (tool.name, tool.translation_mm) for tool in read_tdata(message.content)
                ]
            else:
                ((name, place, _),) = read_qtdata(message.content)
            assert (name, place.tolist()) == ("probeToTracker", [5.0, 5.0, -7.5])
            await peer.ask(Message(f"STP_{kind}", "nav"), f"RTS_{kind}")
            served.put(6)
            await frame(peer)
            status = await peer.ask(Message("GET_STATUS"), "STATUS")
            assert "2 of 2" in read_status(status.content).text

    run(test)


def test_a_resolution_is_the_least_time_between_two():
    async def test() -> None:
        async with serving() as served:
            peer = await served.joined()
            await peer.ask(Message("STP_TRANS"), "RTS_TRANS")
            start = Message("STT_TDATA", "slow", write_start(StartStream(3_600_000)))
            await peer.ask(start, "RTS_TDATA")
            for number in range(50):
                served.put(number)
            first = await peer.message()
            assert first.type == "TDATA"
            # An hour has not passed: nothing else has come before this answer.
            await peer.send(Message("GET_CAPABIL"))
            assert (await peer.message()).type == "CAPABILITY"

    run(test)


def test_an_unknown_coordinate_system_is_refused_with_those_there_are():
    async def test() -> None:
        async with serving() as served:
            peer = await served.joined()
            served.put(1)
            await frame(peer)
            start = Message("STT_TDATA", "x", write_start(StartStream(0, "Ras")))
            assert (await peer.ask(start, "RTS_TDATA")).content == b"\1"
            told = read_status((await peer.of("STATUS")).content)
            assert told.code == StatusCode.NOT_FOUND
            assert "Tracker, Probe, Ref" in told.text

    run(test)


def test_transforms_and_positions_begin_and_stop():
    async def test() -> None:
        async with serving() as served:
            peer = await served.joined()
            await peer.ask(Message("STP_TRANSFOR"), "RTS_TRANSFOR")
            assert (await peer.ask(Message("STT_POSITION"), "RTS_POSITION")).content == b"\0"
            served.put(1)
            message = await peer.message()
            assert (message.type, message.device) == ("POSITION", "probeToTracker")
            assert read_position(message.content)[0].tolist() == [1.0, 5.0, -7.5]

    run(test)


def test_single_questions():
    async def test() -> None:
        async with serving() as served:
            peer = await served.joined()
            nothing = await peer.ask(Message("GET_TRANS", "probeToTracker"), "TRANSFORM")
            assert (nothing.device, nothing.content) == ("probeToTracker", b"")
            told = read_status((await peer.ask(Message("GET_STATUS"), "STATUS")).content)
            assert told.code == StatusCode.NOT_READY
            served.put(1, [pose("probe", 1), pose("ref", 1, PoseStatus.MISSING)])
            await peer.of("TRANSFORM")
            found = await peer.ask(Message("GET_TRANSFOR", "probeToTracker"), "TRANSFORM")
            assert read_transform(found.content)[1].tolist() == [1.0, 5.0, -7.5]
            # What is not seen has no body, as the protocol says.
            missing = await peer.ask(Message("GET_TRANS", "refToTracker"), "TRANSFORM")
            assert (missing.device, missing.content) == ("refToTracker", b"")
            own = await peer.ask(Message("GET_STATUS", "refToTracker"), "STATUS")
            assert read_status(own.content).name == "MISSING"
            assert read_status(own.content).code == StatusCode.NOT_PRESENT
            for name, code in (("", 1), ("Lumiline", 1), ("sim", 1), ("nobodyToTracker", 4)):
                told = await peer.ask(Message("GET_STATUS", name), "STATUS")
                assert read_status(told.content).code == code
            assert "probeToTracker" in read_status(told.content).text
            (tool,) = read_tdata((await peer.ask(Message("GET_TDATA"), "TDATA")).content)
            assert tool.name == "probeToTracker"
            can = read_capability((await peer.ask(Message("GET_CAPABIL"), "CAPABILITY")).content)
            assert {"GET_TRANS", "STT_TDATA", "STP_QTDATA", "COMMAND", "GET_POINT"} <= set(can)

    run(test)


def test_points_are_markers_tips_and_landmarks():
    markers = np.array([[0.0, 0.0, 0.0], [10.0, 0.0, 0.0]])
    host = FakeHost(
        [
            WireTool("probe", "sim", None, markers, np.array([0.0, 0.0, 50.0])),
            WireTool("ref", "sim", None, markers),
            WireTool("other", "elsewhere", None, markers),
        ],
        [Landmark("nose", (1.0, 2.0, 3.0), "Ref")],
    )

    async def test() -> None:
        async with serving(host) as served:
            peer = await served.joined()
            assert (await peer.ask(Message("GET_POINT"), "POINT")).content == b""
            served.put(
                2, [pose("probe", 2, rotation=np.eye(3)), pose("ref", 2, PoseStatus.MISSING)]
            )
            await peer.of("TRANSFORM")
            points = read_points((await peer.ask(Message("GET_POINT"), "POINT")).content)
            found = {point.name: (point.group, point.position_mm, point.owner) for point in points}
            assert found == {
                "probe marker 0": ("Marker", (2.0, 5.0, -7.5), "Tracker"),
                "probe marker 1": ("Marker", (12.0, 5.0, -7.5), "Tracker"),
                "probe tip": ("Tip", (2.0, 5.0, 42.5), "Tracker"),
                "nose": ("Landmark", (1.0, 2.0, 3.0), "Ref"),
            }
            marks = await peer.ask(Message("GET_POINT", "Landmarks"), "POINT")
            assert [point.name for point in read_points(marks.content)] == ["nose"]

    run(test)


def test_landmarks_do_not_outlive_what_they_were_measured_with():
    """Void are those in the world of another calibration, and all those of another table."""
    fixed, carried = Provenance("ct", True, "first", None), Provenance("mr", False, "first", None)
    host = FakeHost(
        marked=[
            Landmark("ct nose", (1.0, 2.0, 3.0), "Tracker", fixed),
            Landmark("ct chin", (1.0, 2.0, 4.0), "Tracker", fixed),
            Landmark("mr ear", (4.0, 5.0, 6.0), "Ref", carried),
        ]
    )

    async def test() -> None:
        async with serving(host) as served:
            peer = await served.joined()

            async def asked() -> list[str]:
                marks = await peer.ask(Message("GET_POINT", "Landmarks"), "POINT")
                return [point.name for point in read_points(marks.content)]

            async def told() -> str:
                return read_status((await peer.of("STATUS", "Landmarks")).content).text

            served.put(1)
            await peer.of("TRANSFORM")
            assert await asked() == ["ct nose", "ct chin", "mr ear"]
            # Who has them is told when they do not hold any more, without asking, once.
            served.board.put(entry(2, in_force=("second", None)))
            assert "do not hold any more" in await told()
            assert await asked() == ["mr ear"]
            text = await told()
            assert text.count('registration "ct" was measured with calibration "first"') == 1
            assert '"second" is active' in text
            served.board.put(entry(3, in_force=("first", "map")))
            assert "do not hold any more" in await told()
            assert await asked() == []
            text = await told()
            assert text.count("register again") == 2
            assert 'registration "mr" was measured without a correction table, and "map"' in text
            # They hold again with what they were measured with, and nothing is told then.
            served.put(4)
            assert await asked() == ["ct nose", "ct chin", "mr ear"]
            served.put(5)
            await peer.send(Message("GET_STATUS", "probeToTracker"))
            assert (await peer.of("STATUS")).device == "probeToTracker"

    run(test)


def test_commands_of_both_kinds():
    async def test() -> None:
        async with serving(changes=True) as served:
            peer = await served.joined()
            served.put(1)
            text = '<Command Name="StartRecording" OutputFilename="scan.mha" />'
            command = Message(
                "COMMAND", "nav", write_command(Command(17, "StartRecording", text)), version=2
            )
            answer = await peer.ask(command, "RTS_COMMAND")
            told = read_command(answer.content)
            assert (told.number, told.name) == (17, "StartRecording")
            assert 'Status="SUCCESS"' in told.text
            assert answer.metadata["OutputFilename"] == "scan.h5"
            assert (answer.device, served.host.recording) == ("nav", "scan.h5")
            stop = Message("STRING", "CMD_0042", write_string('<Command Name="StopRecording"/>'))
            old = await peer.ask(stop, "STRING")
            assert old.device == "ACK_0042"
            assert read_string(old.content).startswith('<CommandReply Status="SUCCESS"')
            # Any other text is none of ours.
            await peer.send(Message("STRING", "note", write_string("hello")))
            refused = await peer.ask(Message("STRING", "CMD_1", write_string("<a")), "STRING")
            assert 'Status="FAIL"' in read_string(refused.content)
            assert served.host.audited == [
                ("openigtlink-start-recording", "done"),
                ("openigtlink-stop-recording", "done"),
            ]

    run(test)


def test_a_command_is_carried_out_and_written_down_when_its_sender_is_gone():
    class Slow(FakeHost):
        gate: asyncio.Event

        async def start_recording(self, device_id: str, name: str | None) -> str:
            await self.gate.wait()
            return await super().start_recording(device_id, name)

    async def test() -> None:
        host = Slow()
        host.gate = asyncio.Event()
        async with serving(host, changes=True) as served:
            peer = await served.joined()
            served.put(1)
            text = '<Command Name="StartRecording"/>'
            await peer.send(Message("COMMAND", "", write_command(Command(1, "", text))))
            await until(lambda: served.server.counters.received["COMMAND"] == 1)
            await peer.close()
            number = 2
            while served.server.clients:  # it is noticed when there is something to send
                served.put(number)
                number += 1
                await asyncio.sleep(0.005)
            assert host.audited == []
            host.gate.set()
            await until(lambda: host.audited == [("openigtlink-start-recording", "done")])

    run(test)


def test_tools_that_the_application_does_not_know_are_not_sent_until_it_does():
    async def test() -> None:
        host = FakeHost([])
        async with serving(host) as served:
            peer = await served.joined()
            served.put(1)
            await until(lambda: served.server.counters.frames_sent == 1)
            # Under the name of the reference that it has, not first under another.
            host.known = [WireTool("probe", "sim", "ref"), WireTool("ref", "sim")]
            for number in range(2, 10_000):
                served.put(number)
                await asyncio.sleep(0.005)
                if served.server.named("sim").names:
                    break
            served.put(10_000)
            message = await peer.of("TRANSFORM")
            assert message.device == "probeToRef"

    run(test)


def test_a_renamed_transform_is_told_to_be_no_more():
    async def test() -> None:
        async with serving() as served:
            peer = await served.joined()
            served.put(1)
            await frame(peer)
            served.host.known = [WireTool("probe", "sim", "ref"), WireTool("ref", "sim")]
            await served.server.refresh()
            served.put(2)
            told = await peer.of("STATUS", "probeToTracker")
            assert read_status(told.content).code == StatusCode.NOT_FOUND
            assert (await peer.of("TRANSFORM")).device == "probeToRef"

    run(test)


def test_tools_that_cannot_be_named_are_told_of():
    async def test() -> None:
        host = FakeHost([WireTool("biopsy-needle-a", "sim"), WireTool("biopsy-needle-b", "sim")])
        async with serving(host) as served:
            peer = await served.joined()
            served.put(1, [pose("biopsy-needle-a"), pose("biopsy-needle-b")])
            told = read_status((await peer.of("STATUS")).content)
            assert told.code == StatusCode.CONFIGURATION_ERROR
            assert "biopsy-needle-b" in told.text

    run(test)


def test_only_one_devices_tools_are_sent():
    async def test() -> None:
        async with serving(device="other") as served:
            served.host.known = [WireTool("probe", "sim"), WireTool("needle", "other")]
            await served.server.refresh()
            peer = await served.joined()
            served.board.put(entry(1, [pose("probe", 1)]))
            served.board.put(entry(2, [pose("needle", 2)], device="other"))
            assert (await peer.of("TRANSFORM")).device == "needleToTracker"

    run(test)


def test_no_more_clients_than_are_allowed():
    async def test() -> None:
        async with serving(clients=2) as served:
            first, second = await served.joined(), await served.joined()
            third = await served.connect()
            told = read_status((await third.of("STATUS")).content)
            assert told.code == StatusCode.NOT_ENOUGH_RESOURCE
            with pytest.raises(EOFError):
                await third.message()
            served.put(1)
            await frame(first)
            await frame(second)
            await second.close()
            await until(lambda: served.server.clients == 1)
            fourth = await served.joined()
            await frame(fourth)
            counts = served.server.counters
            assert counts.refused == {"full": 1}
            assert counts.ended == {"closed by the client": 1}

    run(test)


@both_loops
def test_clients_are_told_when_the_server_stops(loop: str):
    async def test() -> None:
        async with serving() as served:
            peer = await served.joined()
            await served.server.close()
            told = read_status((await peer.of("STATUS")).content)
            assert told.code == StatusCode.SHUT_DOWN
            with pytest.raises(EOFError):
                await peer.message()

    run(test, loop)


def test_poses_of_a_device_that_has_stopped_are_not_sent_again(
    monkeypatch: pytest.MonkeyPatch,
):
    async def test() -> None:
        async with serving() as served:
            peer = await served.joined()
            served.put(1)
            await frame(peer)
            monkeypatch.setattr("service.protocols.openigtlink.server._LOOK_S", 0.01)
            monkeypatch.setattr("service.protocols.openigtlink.snapshot.STALE_S", 0.01)
            monkeypatch.setattr("service.protocols.openigtlink.snapshot._MISSED", 0.0)
            told = read_status((await peer.of("STATUS")).content)
            assert told.code == StatusCode.TIME_OUT
            assert "sim" in told.text
            await asyncio.sleep(0.1)  # it is not told again
            await peer.send(Message("GET_CAPABIL"))
            assert (await peer.message()).type == "CAPABILITY"
            late = await served.joined()
            for one in (late, peer):
                found = await one.ask(Message("GET_TRANS", "probeToTracker"), "TRANSFORM")
                assert found.content == b""
            monkeypatch.setattr("service.protocols.openigtlink.snapshot.STALE_S", 1e6)
            served.put(2)
            assert read_status((await peer.of("STATUS")).content).text == "frames come again"
            await frame(peer)

    run(test)


def test_poses_that_come_too_late_are_not_sent(monkeypatch: pytest.MonkeyPatch):
    async def test() -> None:
        async with serving() as served:
            peer = await served.joined()
            now_ns = entry(0).exposure_ns
            old = replace(entry(1), exposure_ns=now_ns - 10**16)
            for _ in range(3):
                served.board.put(old)
            told = read_status((await peer.of("STATUS")).content)
            assert told.code == StatusCode.TIME_OUT
            served.put(2)
            probe, _ = await frame(peer)
            assert probe.time_ns == entry(2).exposure_ns
            assert served.server.counters.frames_stale == 3

    run(test)
