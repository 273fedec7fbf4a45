"""`lumiline tools create` and `capture`: adds tools to a server, from a file or by capture."""

from collections.abc import Iterable
from contextlib import suppress
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import Annotated, Any, Final

import typer

from lumiline.client.models import Tool
from service.cli.json_files import read_json
from service.cli.options import HERE, AsJson, Key, StrobeMarkers, Url, numbers
from service.cli.output import fail, hint, print_json, progress, say
from service.cli.server_session import client_session

_OF_THE_SERVER: Final = ("tip", "origin", "created_at", "updated_at")
"""Members that GET sends and POST does not take."""


def create(
    file: Annotated[
        Path, typer.Argument(help="A tool or a list as JSON, as POST takes it or GET sends it.")
    ],
    device: Annotated[
        str | None, typer.Option(help="Of this device; left out: the file's.")
    ] = None,
    tool_id: Annotated[
        str | None, typer.Option("--id", help="Of the one tool in the file; left out: the file's.")
    ] = None,
    url: Url = HERE,
    key: Key = None,
    as_json: AsJson = False,
) -> None:
    """Make tools whose markers a file has."""
    tools = _in_order(_read(file))
    if tool_id is not None:
        if len(tools) != 1:
            raise fail(f"--id is for a file of one tool; {file} has {len(tools)}")
        tools[0]["id"] = tool_id
    created: list[Tool] = []
    with client_session(url, key) as client:
        for tool in tools:
            if device is not None:
                tool["device_id"] = device
            for name in ("id", "device_id", "markers_mm"):
                if name not in tool:
                    option = (
                        "" if name == "markers_mm" else f", or give --{name.removesuffix('_id')}"
                    )
                    raise fail(f"{file}: a tool has no {name}; write it there{option}")
            answer = client.request("POST", "/api/v1/tools", body={"title": tool["id"], **tool})
            created.append(Tool.model_validate(answer))
            if not as_json:
                _say_created(created[-1])
    if as_json:
        print_json(created)


def capture(
    tool: Annotated[str, typer.Argument(help="The id that it gets.")],
    device: Annotated[str, typer.Option(help="The running device that sees it.")],
    markers: Annotated[
        int | None, typer.Option(help="How many it has, lit together; nothing else is lit.")
    ] = None,
    strobe_markers: StrobeMarkers = None,
    seconds: Annotated[float, typer.Option(min=0.05, max=60.0, help="How long to look.")] = 1.0,
    title: Annotated[str | None, typer.Option(help="For people.")] = None,
    url: Url = HERE,
    key: Key = None,
    as_json: AsJson = False,
) -> None:
    """Make a tool by showing it: hold it still until this answers."""
    if (markers is None) == (strobe_markers is None):
        raise fail("give --markers or --strobe-markers: how many are lit together, or which slots")
    slots = None
    if strobe_markers is not None:
        slots = numbers(strobe_markers, "--strobe-markers", "0,1,2,3")
    with client_session(url, key) as client, progress("looking"):
        hint(f"Hold {tool} still in view of {device}.")
        created = client.capture_tool(
            id=tool, device_id=device, title=title or tool, duration_s=seconds,
            markers=markers, strobe_markers=slots,
        )  # fmt: skip
    if as_json:
        print_json(created)
        return
    _say_created(created)
    for number, position in enumerate(created.markers_mm, start=1):
        say(f"  marker {number}: " + " ".join(f"{value:9.3f}" for value in position))


def _say_created(tool: Tool) -> None:
    say(f"made: {tool.id}, {len(tool.markers_mm)} markers, of device {tool.device_id}")


def _read(path: Path) -> list[dict[str, Any]]:
    """Return a file's tools as POST takes them, from what GET sends or POST takes."""
    content = read_json(path)
    if isinstance(content, dict):
        content = content.get("items", [content])
    if not isinstance(content, list) or not content:
        raise fail(f"{path} holds no tools; a tool is what POST /api/v1/tools takes")
    if not all(isinstance(one, dict) for one in content):
        raise fail(f"{path}: each tool must be an object, as POST /api/v1/tools takes it")
    tools = []
    for sent in content:
        tool = {name: value for name, value in sent.items() if name not in _OF_THE_SERVER}
        tip = sent.get("tip")
        if isinstance(tip, dict) and tip.get("position_mm") is not None:
            tool.setdefault("tip_mm", tip["position_mm"])
        tools.append(tool)
    return tools


def _in_order(tools: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return tools so that each stands behind its reference, where that is among them."""
    listed = list(tools)
    number = {one["id"]: index for index, one in enumerate(listed) if one.get("id") is not None}
    references = {
        index: {number[one["reference_id"]]} if one.get("reference_id") in number else set()
        for index, one in enumerate(listed)
    }
    sorter, ordered = TopologicalSorter(references), list[int]()
    with suppress(CycleError):
        sorter.prepare()
    while ready := sorter.get_ready():
        ordered += ready
        sorter.done(*ready)
    # A ring comes last: the server says what is wrong with it.
    ordered += [index for index in references if index not in ordered]
    return [listed[index] for index in ordered]
