"""A real server holds a beam: set up, streamed, moved, stopped; by both clients and by hand."""

import asyncio
import json
import re
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from typer.testing import CliRunner

from compute.camera.stack import CameraStack
from hardware.simulated.simulated_rig import simulated_rig
from lumiline.client import AsyncClient, Client
from lumiline.client.messages import BeamHoldEvent, Frame, Hello, Message
from lumiline.client.stream import Stream
from service.cli import app
from tests.running_server import serving

GUIDE = Path(__file__).parents[3] / "docs" / "how-to" / "beam-holds.md"
MARKERS = [[0.0, 0.0, 0.0], [80.0, 0.0, 0.0], [0.0, 60.0, 0.0], [20.0, 15.0, 40.0]]
SCENE = {"kind": "moving-tools", "moving": False, "tools": [{"markers_mm": MARKERS}]}
WATCH = {"kind": "strobed-markers", "markers": [0, 1, 2, 3]}
CHEST: dict[str, Any] = {
    "id": "chest", "device_id": "sim", "title": "chest", "watch": WATCH,
    "limits": {"shift_mm": 3.0},
}  # fmt: skip
# A busy machine leaves out frames: only what a test is about is to hold.
PATIENT_RULES = {"max_gap_s": 10.0, "settle_s": 0.1}


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Client]:
    """A client of a server whose device shows four markers at rest, 100 frames a second."""
    with serving(tmp_path_factory.mktemp("server")) as url, Client(url, timeout_s=120.0) as made:
        settings = {"frame_rate_hz": 100, "scene": SCENE}
        source = {"kind": "simulated", "settings": settings}
        made.request("PATCH", "/api/v1/devices/sim", body={"source": source})
        made.start_device("sim")
        yield made


@pytest.fixture
def hold(client: Client) -> Iterator[str]:
    """A hold of 3 mm, set up."""
    members: dict[str, Any] = {"rules": PATIENT_RULES}
    client.create_beam_hold(**CHEST, **members)
    client.set_beam_hold_reference("chest", frames=20, timeout_s=60.0)
    yield "chest"
    client.delete_beam_hold("chest")


def until(stream: Stream, held: bool) -> BeamHoldEvent:
    """Return the change by which a beam is held, or goes on."""
    end = time.monotonic() + 240.0
    for message in stream:
        assert time.monotonic() < end, "it did not come"
        if isinstance(message, BeamHoldEvent) and message.held is held:
            return message
    raise AssertionError("the stream ended")


def wait_for(client: Client, held: bool) -> None:
    end = time.monotonic() + 240.0
    while (now := client.beam_hold_state("chest")).held is not held:
        assert time.monotonic() < end, now
        time.sleep(0.05)


@pytest.mark.slow
def test_from_the_set_up_to_the_stop(client: Client) -> None:
    members: dict[str, Any] = {"rules": PATIENT_RULES}
    made = client.create_beam_hold(**CHEST, **members)
    assert made.reference is None
    with client.stream("sim", ["holds"], rate_hz=5) as stream:
        hello = next(iter(stream))
        assert isinstance(hello, Hello)
        assert hello.holds is not None
        assert [(one.hold_id, one.held) for one in hello.holds] == [("chest", True)]
        referred = client.set_beam_hold_reference("chest", frames=20, timeout_s=60.0)
        assert referred.reference is not None
        assert len(referred.reference.positions_mm) == 4
        went_on = until(stream, held=False)
        assert (went_on.hold_id, went_on.cause, went_on.reason) == ("chest", "none", None)
        frame = next(one for one in stream if isinstance(one, Frame))
        assert frame.holds is not None
        assert (frame.holds[0].held, frame.points) == (False, None)
        # The noise alone is more than that.
        client.change_beam_hold("chest", limits={"shift_mm": 1e-4})
        moved = next(
            one for one in stream if isinstance(one, BeamHoldEvent) and one.cause == "moved"
        )
        assert moved.held
        assert "off its reference position (limit 0.00 mm)" in str(moved.reason)
        client.change_beam_hold("chest", limits={"shift_mm": 3.0})
        until(stream, held=False)
        client.stop_device("sim")
        stopped = until(stream, held=True)
        assert (stopped.cause, stopped.reason) == ("no-data", "the device is stopped")
        client.start_device("sim")
        until(stream, held=False)
        client.delete_beam_hold("chest")
        assert until(stream, held=True).reason == "the hold was deleted"


@pytest.mark.slow
def test_who_did_not_ask_for_holds_hears_nothing_of_them(client: Client, hold: str) -> None:
    wait_for(client, held=False)
    with (
        client.stream("sim", ["points"]) as stream,
        client.stream("sim", ["state"]) as quiet,
        client.stream("sim", ["holds", "points"]) as asked,
    ):
        for one in (stream, quiet, asked):
            assert isinstance(next(iter(one)), Hello)
        client.stop_device("sim")
        client.start_device("sim")
        heard: list[Message] = []
        for one in (stream, quiet):
            for message in one:
                heard.append(message)
                if getattr(message, "state", None) == "running":
                    break
        assert not [one for one in heard if isinstance(one, BeamHoldEvent)]
        assert all(one.holds is None for one in heard if isinstance(one, Frame))
        assert until(asked, held=True).cause == "no-data"


def test_another_calibration_holds_until_it_is_back(client: Client, hold: str) -> None:
    wait_for(client, held=False)
    active = client.device("sim").active_calibration_id
    body = {"id": "again", "device_id": "sim", "points": _points()}
    client.request("POST", "/api/v1/calibrations", body=body)
    try:
        client.activate_calibration("again")
        wait_for(client, held=True)
        state = client.beam_hold_state("chest")
        assert state.cause == "no-data"
        assert f'taken with calibration "{active}", and "again" is active' in str(state.reason)
    finally:
        client.activate_calibration(str(active))
    wait_for(client, held=False)


def _points() -> list[dict[str, Any]]:
    """Return control points with the readings of the simulator's cameras."""
    models = [sensor.model for sensor in simulated_rig()]
    grid = np.stack(
        np.meshgrid([-200.0, 0.0, 200.0], [-150.0, 150.0], [1300.0, 1500.0, 1700.0]), axis=-1
    ).reshape(-1, 3)
    readings = CameraStack.of(models).project(grid)
    noise = np.random.default_rng(1).normal(0.0, 0.05, readings.shape)
    return [
        {
            "name": f"P{row}",
            "position_mm": place.tolist(),
            "readings": {
                model.name: float(value) for model, value in zip(models, given, strict=True)
            },
        }
        for row, (place, given) in enumerate(zip(grid, readings + noise, strict=True))
    ]


def test_the_same_by_the_client_for_asyncio(client: Client, hold: str) -> None:
    async def run() -> None:
        async with AsyncClient(client._server.url) as other:
            assert (await other.beam_hold("chest")).id == "chest"
            assert [one.id for one in await other.beam_holds(device_id="sim")] == ["chest"]
            assert (await other.acknowledge_beam_hold("chest")).hold_id == "chest"
            async with other.stream("sim", ["holds"], rate_hz=5) as stream:
                async for frame in stream.frames():
                    assert frame.holds is not None
                    assert frame.holds[0].hold_id == "chest"
                    break
            assert (await other.remove_beam_hold_reference("chest")).reference is None
            assert (await other.beam_hold_state("chest")).held

    asyncio.run(run())


@pytest.mark.slow
def test_the_program_of_the_guide(
    client: Client, hold: str, capsys: pytest.CaptureFixture[str]
) -> None:
    wait_for(client, held=False)
    (program,) = re.findall(r"```python\n(.*?)```", GUIDE.read_text(), re.DOTALL)
    for given, here in (
        ("http://127.0.0.1:8000", client._server.url),
        ('"chest", 0.2', '"chest", 60.0'),
        ("gate(5.0)", "gate(0.5)"),
    ):
        assert given in program
        program = program.replace(given, here)
    exec(compile(program, GUIDE.name, "exec"), {})
    assert set(capsys.readouterr().out.split()) == {"on"}
    client.remove_beam_hold_reference("chest")
    exec(compile(program, GUIDE.name, "exec"), {})
    assert set(capsys.readouterr().out.split()) == {"held"}


def test_prometheus_knows(client: Client, hold: str) -> None:
    wait_for(client, held=False)
    metrics = httpx.get(f"{client._server.url}/metrics").text
    assert 'lumiline_hold_held{device="sim",hold="chest"} 0.0' in metrics


def lumiline(client: Client, *arguments: str, code: int = 0) -> str:
    given = ["beam-holds", *arguments, "--url", client._server.url]
    run = CliRunner().invoke(app, given, env={"COLUMNS": "160"})
    assert run.exit_code == code, run.output
    return run.output


@pytest.mark.slow
def test_holds_on_the_command_line(client: Client, hold: str) -> None:
    wait_for(client, held=False)
    assert "on" in lumiline(client, "show", "chest")
    assert '"held": false' in lumiline(client, "show", "chest", "--json")
    lines = lumiline(client, "watch", "chest", "--seconds", "0.5", "--json").splitlines()
    assert [json.loads(line)["held"] for line in lines][-1:] == [False]
    client.remove_beam_hold_reference("chest")
    listed = lumiline(client, "list")
    assert "HELD" in listed
    assert "no-data" in listed
    (both,) = json.loads(lumiline(client, "list", "--json"))
    assert (both["hold"]["id"], both["state"]["held"]) == ("chest", True)
    assert "no-data" in lumiline(client, "show", "chest", code=1)
    assert "no-data" in lumiline(client, "acknowledge", "chest")
    assert "HELD  no-data" in lumiline(client, "watch", "chest", "--seconds", "0.5", code=1)
    assert "no hold" in lumiline(client, "show", "nothing", code=2)
