"""Poses from the board: whose they are, how old, and the wait for newer ones."""

import asyncio

import numpy as np

from compute.pose.rigid_body import PoseStatus
from service.api.tools.frame_conversion import pose_in_frame
from service.api.tools.tip_limit import TipLimit
from service.pipeline.frame_batch import LatestPoses
from service.protocols.ndi.client_state import Identity
from service.protocols.ndi.command import Command
from service.protocols.ndi.pose_feed import AGE_S, PoseFeed
from service.protocols.ndi.session import Session
from tests.service.protocols.ndi.fake_poses import PATIENT_S, entry, pose


class Clock:
    now = 1000.0

    def __call__(self) -> float:
        return self.now


def test_the_only_device_with_tools():
    async def see() -> None:
        board = LatestPoses()
        feed = PoseFeed(board)
        assert feed.look(None).device_id is None
        board.put(entry(device="empty"))
        board.put(entry(pose("b"), pose("a"), device="bar"))
        view = feed.look(None)
        assert (view.device_id, view.tools, view.sequence) == ("bar", ("a", "b"), 7)
        assert view.fresh
        board.put(entry(pose("c"), device="other"))
        assert feed.look(None).several
        assert feed.look("other").tools == ("c",)
        assert PoseFeed(board, "other").look(None).tools == ("c",)
        board.remove("bar")
        assert feed.look("bar").tools == ()
        assert not feed.look("bar").fresh

    asyncio.run(see())


def test_tools_of_a_device_that_does_not_run():
    """They have handles; stopping and starting plugs none in or out."""

    async def see() -> None:
        limit = TipLimit(1e9)
        known = {"bar": {"b": limit, "a": limit}}
        board = LatestPoses()
        feed = PoseFeed(board, tip_limits=lambda: known)
        session = Session(Identity("Model", "1", "LUMILINE"), feed.look)

        def ask(name: str, text: str) -> str:
            return session.answer(Command(name, text)).decode()

        assert ask("INIT", "").startswith("OKAY")
        assert ask("PHSR", "02").startswith("0201001")
        for handle in ("01", "02"):
            assert ask("PINIT", handle).startswith("OKAY")
            assert ask("PENA", f"{handle}D").startswith("OKAY")
        assert ask("TSTART", "").startswith("OKAY")
        told = ask("TX", "0001")
        assert told.count("MISSING") == 2
        assert told[-9:-5] == "0008"
        board.put(entry(pose("a"), pose("b")))
        assert ask("TX", "0001").count("MISSING") == 0
        board.remove("bar")
        told = ask("TX", "0001")
        assert (told.count("MISSING"), told[-9:-5]) == (2, "0008")
        known["bar"] = {"a": limit}
        assert ask("TX", "0001")[-9:-5] == "0088"
        # Of several that do not run there is no telling which; of those that run there is.
        known["other"] = {"c": limit}
        assert feed.look(None).several
        board.put(entry(pose("c"), device="other"))
        assert feed.look(None).device_id == "other"
        feed.close()

    asyncio.run(see())


def test_poses_grow_old():
    """From when they came."""

    async def see() -> None:
        clock, board = Clock(), LatestPoses()
        board.put(entry(pose("a")))
        feed = PoseFeed(board, now=clock, wall_ns=lambda: 0)
        clock.now += AGE_S
        assert feed.look(None).poses
        clock.now += 0.01
        assert not feed.look(None).poses
        assert feed.look(None).tools == ("a",)
        board.put(entry(pose("a")))
        await asyncio.sleep(0)
        assert feed.look(None).poses
        # A device of one frame a second is not old after half a second.
        board.put(entry(pose("a"), rate_hz=1.0))
        await asyncio.sleep(0)
        clock.now += 4.9
        assert feed.look(None).fresh
        clock.now += 0.2
        assert not feed.look(None).fresh
        feed.close()

    asyncio.run(see())


def test_poses_that_come_late_are_old():
    """The pipeline is behind: they come as they should, and are of seconds ago."""

    async def see() -> None:
        clock, board = Clock(), LatestPoses()
        board.put(given := entry(pose("a")))
        wall = [given.exposure_ns]
        feed = PoseFeed(board, now=clock, wall_ns=lambda: wall[0])
        wall[0] += int(2e9 * AGE_S)
        assert feed.look(None).fresh
        wall[0] += 10**7
        assert not feed.look(None).fresh
        feed.close()

    asyncio.run(see())


def test_waiting_for_another_frame():
    async def see() -> None:
        board = LatestPoses()
        board.put(entry(pose("a"), sequence=1))
        feed = PoseFeed(board)
        waiting = asyncio.create_task(feed.newer(None, 1, PATIENT_S))
        await asyncio.sleep(0)
        board.put(entry(pose("a"), sequence=1))
        for _ in range(5):
            await asyncio.sleep(0)
        assert not waiting.done()
        board.put(entry(pose("a"), sequence=2))
        await waiting
        await feed.newer(None, 2, 0.0)  # patience ends
        await feed.newer(None, 1, PATIENT_S)  # it is there
        feed.close()

    asyncio.run(see())


def test_markers_come_along():
    async def see() -> None:
        board = LatestPoses()
        board.put(entry(pose("a")))
        feed = PoseFeed(board, markers=lambda device, tool: np.full((3, 3), len(device + tool)))
        found = feed.look(None).markers("a")
        assert found is not None
        assert (found == 4).all()

    asyncio.run(see())


def test_what_a_driver_forms_of_two_poses_is_judged():
    """As the tool's pose relative to its reference is over REST: by both errors together."""

    async def see() -> None:
        board = LatestPoses()
        probe = pose("probe", seed=1)
        patient = pose("patient", seed=2)
        alone, both = (pose_in_frame(probe, one).tip_covariance_mm2 for one in (None, patient))
        assert alone is not None
        assert both is not None
        alone_mm, both_mm = float(np.trace(alone)) ** 0.5, float(np.trace(both)) ** 0.5
        assert 1.2 * alone_mm < both_mm
        known: dict[str, TipLimit] = {"patient": TipLimit(1e9)}
        feed = PoseFeed(board, age_s=PATIENT_S, tip_limits=lambda: {"bar": known})
        session = Session(Identity("Model", "1", "LUMILINE"), feed.look)

        def tx() -> list[str]:
            """What is told of the probe and of the patient."""
            return session.answer(Command("TX", "0003")).decode().split("\n")[1::-1]

        def given() -> list[bool]:
            return ["MISSING" not in one for one in tx()]

        board.put(entry(probe, patient))
        for command, text in (
            ("INIT", ""), ("PHSR", "02"), ("PINIT", "01"), ("PENA", "01D"), ("PINIT", "02"),
            ("PENA", "02D"), ("TSTART", ""),
        ):  # fmt: skip
            session.answer(Command(command, text))
        assert given() == [True, True]  # nothing is known of the probe yet
        known["probe"] = TipLimit(0.5 * (alone_mm + both_mm))
        assert given() == [True, True]
        known["probe"] = TipLimit(0.5 * (alone_mm + both_mm), reference="patient")
        assert given() == [False, True]
        assert tx()[0].endswith("01" + "0" * 16 + "3333")  # of the tool information: a bad fit
        known["probe"] = TipLimit(1.001 * both_mm, reference="patient")
        assert given() == [True, True]
        # The tip's own error counts.
        known["probe"] = TipLimit(1.001 * both_mm, both, "patient")
        assert given() == [False, True]
        known["probe"] = TipLimit(0.5 * (alone_mm + both_mm), reference="patient")
        # With a reference that is not given nothing can be formed.
        board.put(entry(probe, pose("patient", PoseStatus.HIGH_ERROR, seed=2)))
        assert given() == [True, False]
        feed.close()

    asyncio.run(see())
