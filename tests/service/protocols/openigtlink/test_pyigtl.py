"""A client that is not ours: pyigtl receives exactly what was put up."""

import asyncio
import threading
from collections import defaultdict

import numpy as np
import pyigtl
import pytest

from compute.transform import rotation_matrix
from service.protocols.openigtlink.host import WireTool
from tests.service.protocols.openigtlink.test_client import (
    LOOPS,
    START_NS,
    FakeHost,
    pose,
    run,
    serving,
    until,
)

TOOLS = [f"tool-{number}" for number in range(10)]
FRAMES = 100


class Kept(dict[str, pyigtl.MessageBase]):
    """Keeps every message of each name: pyigtl itself keeps the last."""

    def __init__(self) -> None:
        super().__init__()
        self.all: dict[str, list[pyigtl.MessageBase]] = defaultdict(list)

    def __setitem__(self, name: str, message: pyigtl.MessageBase) -> None:
        self.all[name].append(message)


def turned(number: int, tool: int) -> tuple[np.ndarray, np.ndarray]:
    turn = np.array([0.01 * number, 0.1 * tool, -0.3])
    return rotation_matrix(turn), np.array([number + 0.25, tool - 100.5, 1e-3 * number])


@pytest.mark.slow
@pytest.mark.parametrize("loop", LOOPS)
def test_ten_tools_while_another_client_stalls_and_leaves(loop: str):
    async def test() -> None:
        host = FakeHost([WireTool(tool, "sim") for tool in TOOLS])
        async with serving(host) as served:
            client = pyigtl.OpenIGTLinkClient(port=served.server.address[1], start_now=False)
            kept = client.incoming_messages = Kept()
            client.start()
            try:
                await until(lambda: served.server.clients == 1)
                stalled = await served.joined()
                stalled.writer.transport.pause_reading()
                for number in range(FRAMES):
                    if number == FRAMES // 2:
                        await stalled.close()
                    served.put(
                        number,
                        [
                            pose(tool, number, rotation=rotation, translation_mm=translation)
                            for index, tool in enumerate(TOOLS)
                            for rotation, translation in [turned(number, index)]
                        ],
                    )
                    # As fast as it takes them: nothing may be replaced in this test.
                    await until(lambda count=number: len(kept.all["tool-9ToTracker"]) > count)
            finally:
                stopping = threading.Thread(target=client.stop)
                stopping.start()
                while stopping.is_alive():
                    await asyncio.sleep(0.01)
        assert set(kept.all) == {f"{tool}ToTracker" for tool in TOOLS}
        for index, tool in enumerate(TOOLS):
            messages = kept.all[f"{tool}ToTracker"]
            assert len(messages) == FRAMES
            for number, message in enumerate(messages):
                rotation, translation = turned(number, index)
                assert np.array_equal(message.matrix[:3, :3], rotation.astype(np.float32))
                assert np.array_equal(message.matrix[:3, 3], translation.astype(np.float32))
                assert message.timestamp == pytest.approx((START_NS + number) * 1e-9, abs=1e-6)

    run(test, loop)


def test_a_string_command_of_pyigtl():
    async def test() -> None:
        async with serving() as served:
            client = pyigtl.OpenIGTLinkClient(port=served.server.address[1])
            try:
                text = '<Command Name="Version" />'
                message = pyigtl.StringMessage(text, device_name="CMD_7")
                message.header_version = 2
                client.send_message(message, wait=False)
                answer = None
                while answer is None:
                    await asyncio.sleep(0.01)
                    answer = client.wait_for_message("ACK_7", timeout=0)
                assert answer.header_version == 2
                assert answer.string.startswith('<CommandReply Status="SUCCESS"')
            finally:
                await asyncio.get_running_loop().run_in_executor(None, client.stop)

    run(test)
