"""`lumiline tools create` and `capture`: adds tools to a server, from a file or by capture."""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Final

from lumiline.client.models import Tool
from service.cli.client_session import client_session
from service.cli.output import console, fail, print_json

_OF_THE_SERVER: Final = ("tip", "origin", "created_at", "updated_at")
"""Members that GET sends and POST does not take."""


def create(
    path: Path, device: str | None, tool_id: str | None, url: str, key: str | None, *, as_json: bool
) -> None:
    """Make the tools of a file; the first that is refused ends the command with its reason."""
    found = _in_order(_read(path))
    if tool_id is not None:
        if len(found) != 1:
            raise fail(f"--id is for a file of one tool; {path} has {len(found)}")
        found[0]["id"] = tool_id
    made: list[Tool] = []
    with client_session(url, key) as client:
        for one in found:
            if device is not None:
                one["device"] = device
            for name in ("id", "device", "markers_mm"):
                if name not in one:
                    option = "" if name == "markers_mm" else f", or give --{name}"
                    raise fail(f"{path}: a tool has no {name}; write it there{option}")
            members = {"title": one["id"], **one}
            made.append(Tool.model_validate(client.request("POST", "/api/v1/tools", body=members)))
            if not as_json:
                _tell(made[-1])
    if as_json:
        print_json([tool.model_dump(mode="json") for tool in made])


def capture(
    tool_id: str,
    device: str,
    markers: int | None,
    strobe_markers: str | None,
    seconds: float,
    title: str | None,
    url: str,
    key: str | None,
    *,
    as_json: bool,
) -> None:
    """Make a tool of what a running device sees of it."""
    if (markers is None) == (strobe_markers is None):
        raise fail("give --markers or --strobe-markers: how many are lit together, or which slots")
    slots = None if strobe_markers is None else _numbers(strobe_markers)
    with client_session(url, key) as client:
        if not as_json:
            console.print(f"Hold {tool_id} still in view of {device}.", highlight=False)
        made = client.capture_tool(
            tool_id,
            device,
            markers=markers,
            strobe_markers=slots,
            seconds=seconds,
            title=title or tool_id,
        )
    if as_json:
        print_json(made.model_dump(mode="json"))
        return
    _tell(made)
    for number, place in enumerate(made.markers_mm, start=1):
        console.print(
            f"  marker {number}: " + " ".join(f"{value:9.3f}" for value in place), highlight=False
        )


def _tell(tool: Tool) -> None:
    console.print(
        f"made: {tool.id}, {len(tool.markers_mm)} markers, of device {tool.device}", highlight=False
    )


def _numbers(text: str) -> list[int]:
    try:
        return [int(one) for one in text.replace(",", " ").split()]
    except ValueError:
        raise fail(f'--strobe-markers is "{text}"; give numbers, such as 0,1,2,3') from None


def _read(path: Path) -> list[dict[str, Any]]:
    try:
        content = json.loads(path.read_bytes())
    except OSError as error:
        raise fail(f"{path} cannot be read: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise fail(f"{path} is not JSON: {error}") from error
    if isinstance(content, dict):
        content = content.get("items", [content])
    if not isinstance(content, list) or not content:
        raise fail(f"{path} holds no tools; a tool is what POST /api/v1/tools takes")
    if not all(isinstance(one, dict) for one in content):
        raise fail(f"{path}: each tool must be an object, as POST /api/v1/tools takes it")
    return [_given(one) for one in content]


def _given(tool: dict[str, Any]) -> dict[str, Any]:
    """Return a tool as POST takes it, from what GET sends or POST takes."""
    given = {name: value for name, value in tool.items() if name not in _OF_THE_SERVER}
    tip = tool.get("tip")
    if isinstance(tip, dict) and tip.get("position_mm") is not None:
        given.setdefault("tip_mm", tip["position_mm"])
    return given


def _in_order(tools: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return tools so that each stands behind its reference, where that is among them."""
    waiting, ordered = list(tools), []
    while waiting:
        names = {one.get("id") for one in waiting}
        free = [one for one in waiting if one.get("reference") not in names - {None}]
        # In a ring nobody is free: the server says so.
        ordered += free or waiting
        waiting = [one for one in waiting if free and all(one is not other for other in free)]
    return ordered
