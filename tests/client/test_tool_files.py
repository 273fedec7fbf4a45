"""`lumiline tools create` and `capture`, and capturing by the clients, beside a server."""

import asyncio
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from typer.testing import CliRunner

from lumiline.client import AsyncClient, Client, ServerProblem
from lumiline.client.models import Tool
from service.cli import app
from service.cli.tool_files import _in_order

EXAMPLE = Path(__file__).parents[2] / "docs" / "examples" / "tool.json"
MARKERS = [[0.0, 0.0, 0.0], [80.0, 0.0, 0.0], [0.0, 60.0, 0.0], [20.0, 15.0, 40.0]]

Command = Callable[..., Any]


@pytest.fixture
def command(server: str) -> Iterator[Command]:
    """Run `lumiline tools ...` beside the server; what it made is deleted."""

    def run(*arguments: str | Path, code: int = 0) -> Any:
        given = ["tools", *map(str, arguments), "--url", server]
        result = CliRunner().invoke(app, given, env={"COLUMNS": "200"})
        assert result.exit_code == code, result.output
        return result

    yield run
    with Client(server) as client:
        while found := client.tools():
            referred = {tool.reference_id for tool in found}
            for tool in found:
                if tool.id not in referred:
                    client.delete_tool(tool.id)


def written(tmp_path: Path, content: Any) -> Path:
    path = tmp_path / "tools.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content), "utf-8")
    return path


@pytest.mark.slow
def test_the_example_is_made(command: Command, server: str) -> None:
    assert "made: pointer, 4 markers, of device sim" in command("create", EXAMPLE).output
    with Client(server) as client:
        tool = client.tool("pointer")
    given = json.loads(EXAMPLE.read_bytes())
    assert [list(marker) for marker in tool.markers_mm] == given["markers_mm"]
    assert tool.tip.position_mm == tuple(given["tip_mm"])
    assert tool.strobe_markers == tuple(given["strobe_markers"])
    # Once more it is refused, with the server's words.
    assert 'tool "pointer" exists already' in command("create", EXAMPLE, code=2).output


def test_what_one_server_sends_another_takes(command: Command, server: str, tmp_path: Path) -> None:
    """With the reference behind what refers to it, as an alphabetical list may have it."""
    tools = [
        {"id": "a", "device_id": "sim", "markers_mm": MARKERS, "strobe_markers": [0, 1, 2, 3],
         "reference_id": "b", "limits": {"tip_sd_mm": 0.7}, "tip_mm": [0, 0, 150], "title": "A"},
        {"id": "b", "device_id": "sim", "markers_mm": MARKERS, "strobe_markers": [4, 5, 6, 7]},
    ]  # fmt: skip
    made = json.loads(command("create", written(tmp_path, tools), "--json").stdout)
    assert [one["id"] for one in made] == ["b", "a"]
    sent = httpx.get(f"{server}/api/v1/tools").json()
    for tool in ("a", "b"):
        httpx.delete(f"{server}/api/v1/tools/{tool}").raise_for_status()
    again = written(tmp_path, sent)
    command("create", again)
    told = httpx.get(f"{server}/api/v1/tools").json()
    for before, after in zip(sent["items"], told["items"], strict=True):
        of_the_time = {"created_at", "updated_at"}
        assert {k: v for k, v in after.items() if k not in of_the_time} == {
            k: v for k, v in before.items() if k not in of_the_time
        }


def test_another_id_and_device(command: Command, server: str) -> None:
    assert "made: other" in command("create", EXAMPLE, "--id", "other", "--device", "sim").output
    refused = command("create", EXAMPLE, "--id", "third", "--device", "nix", code=2)
    assert "nix" in refused.output


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("{", "is not JSON"),
        ([], "holds no tools"),
        ("3", "holds no tools"),
        ([1], "each tool must be an object"),
        ({"device_id": "sim", "markers_mm": MARKERS}, "has no id; write it there, or give --id"),
        ({"id": "x", "markers_mm": MARKERS}, "or give --device"),
        ({"id": "x", "device_id": "sim"}, "has no markers_mm"),
        ({"id": "x", "device_id": "sim", "markers_mm": MARKERS, "colour": 1}, "colour"),
        ({"id": "x", "device_id": "sim", "markers_mm": MARKERS[:2]}, "markers_mm"),
        (
            {"id": "x", "device_id": "sim", "markers_mm": [[0, 0, 0], [50, 0, 0], [99, 0, 0]]},
            "lie on a line",
        ),
        ({"id": "x", "device_id": "sim", "markers_mm": MARKERS, "reference_id": "x"}, "reference"),
    ],
)
def test_what_is_refused(command: Command, tmp_path: Path, content: Any, words: str) -> None:
    output = " ".join(command("create", written(tmp_path, content), code=2).output.split())
    assert words in output


def test_files_that_cannot_be_taken(command: Command, tmp_path: Path) -> None:
    assert "cannot be read" in command("create", tmp_path / "none.json", code=2).output
    two = written(tmp_path, [{"id": "a"}, {"id": "b"}])
    assert "has 2" in command("create", two, "--id", "x", code=2).output


def test_those_before_a_refused_one_are_made(command: Command, server: str, tmp_path: Path) -> None:
    good = json.loads(EXAMPLE.read_bytes())
    output = command("create", written(tmp_path, [good, good | {"id": "A B"}]), code=2).output
    assert "made: pointer" in output
    assert "A B" in output
    with Client(server) as client:
        assert [tool.id for tool in client.tools()] == ["pointer"]


def test_references_come_first() -> None:
    chain = [{"id": "a", "reference_id": "b"}, {"id": "b", "reference_id": "c"}, {"id": "c"}]
    assert [one["id"] for one in _in_order(chain)] == ["c", "b", "a"]
    ring = [{"id": "a", "reference_id": "b"}, {"id": "b", "reference_id": "a"}, {"id": "c"}]
    assert [one["id"] for one in _in_order(ring)] == ["c", "a", "b"]
    elsewhere = [{"id": "a", "reference_id": "patient"}]
    assert _in_order(elsewhere) == elsewhere


@pytest.fixture
def still(server: str) -> Iterator[None]:
    """The server's device shows a tool at rest."""
    scene = {"kind": "moving-tools", "tools": [{"markers_mm": MARKERS}], "moving": False}
    before = httpx.get(f"{server}/api/v1/devices/sim").json()["source"]
    for settings in (scene, None):
        source = before
        if settings is not None:
            source = {"kind": "simulated", "settings": {"frame_rate_hz": 100, "scene": settings}}
        httpx.post(f"{server}/api/v1/devices/sim/stop", timeout=60.0).raise_for_status()
        httpx.patch(
            f"{server}/api/v1/devices/sim", json={"source": source}, headers={"If-Match": "*"}
        ).raise_for_status()
        httpx.post(f"{server}/api/v1/devices/sim/start", timeout=60.0).raise_for_status()
        if settings is not None:
            yield


@pytest.mark.slow
@pytest.mark.usefixtures("still")
def test_a_tool_that_is_shown(command: Command, server: str) -> None:
    """By the command and by both clients: markers lie as in the scene."""
    command("capture", "one", "--device", "sim", "--strobe-markers", "0,1,2,3")

    async def together() -> Tool:
        async with AsyncClient(server) as client:
            await client.delete_tool("one")
            return await client.capture_tool(
                id="two", device_id="sim", title="two", strobe_markers=[0, 1, 2, 3], duration_s=0.8
            )

    with Client(server) as client:
        tools = [client.tool("one"), asyncio.run(together())]
        client.delete_tool("two")
        tools.append(
            client.capture_tool(id="three", device_id="sim", title="T", strobe_markers=[0, 1, 2, 3])
        )
        with pytest.raises(ServerProblem) as caught:
            client.capture_tool(
                id="four",
                device_id="sim",
                title="four",
                strobe_markers=[20, 21, 22],
                duration_s=0.2,
            )
    assert caught.value.code == "invalid-parameter"
    assert "20" in caught.value.detail
    assert [tool.title for tool in tools] == ["one", "two", "T"]
    pairs = [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)]
    for tool in tools:
        found, true = np.array(tool.markers_mm), np.array(MARKERS)
        for one, other in pairs:
            distance = np.linalg.norm(found[one] - found[other])
            assert distance == pytest.approx(np.linalg.norm(true[one] - true[other]), abs=1.5)


def test_what_is_not_said_of_a_tool_to_show(command: Command) -> None:
    for given in ([], ["--markers", "4", "--strobe-markers", "0,1,2"]):
        output = command("capture", "x", "--device", "sim", *given, code=2).output
        assert "--markers or --strobe-markers" in " ".join(output.split())
    output = command("capture", "x", "--device", "sim", "--strobe-markers", "0,a", code=2).output
    assert "whole numbers" in output
