"""`lumiline tools`: tools of a running server and their poses, through the client."""

import time
from collections.abc import Callable, Iterable
from math import sqrt
from typing import Final

import typer
from rich.console import Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from lumiline.client.models import Matrix3, Pose, Tool
from service.cli.client_session import client_session
from service.cli.output import console, fail, print_json

REFRESHES_PER_S: Final = 5.0
_STYLES: Final = {"OK": "green", "HIGH_ERROR": "yellow", "OUT_OF_VOLUME": "yellow"}


def show_all(url: str, key: str | None, device: str | None, *, as_json: bool) -> None:
    """Print the tools."""
    with client_session(url, key) as client:
        found = client.tools(device)
    if as_json:
        print_json([tool.model_dump(mode="json") for tool in found])
        return
    table = Table()
    for heading in ("id", "device", "title", "markers", "strobed", "tip [mm]", "relative to"):
        table.add_column(heading, overflow="fold")
    for tool in found:
        table.add_row(
            tool.id, tool.device, tool.title, str(len(tool.markers_mm)), _strobed(tool),
            _vector(tool.tip.position_mm), tool.reference or "tracker",
        )  # fmt: skip
    console.print(table)


def show_one(url: str, key: str | None, tool_id: str, frame: str | None, *, as_json: bool) -> None:
    """Print a tool's newest pose; exit code 1 where it is not OK."""
    with client_session(url, key) as client:
        tool, pose = client.tool(tool_id), client.tool_pose(tool_id, frame)
    if as_json:
        documents = {"tool": tool.model_dump(mode="json"), "pose": pose.model_dump(mode="json")}
        print_json(documents)
    else:
        console.print(f"{tool.id}: {tool.title}, {len(tool.markers_mm)} markers", highlight=False)
        console.print(_poses([pose]))
    if pose.status != "OK":
        raise typer.Exit(1)


def measure(
    url: str,
    key: str | None,
    tool_id: str,
    frame: str | None,
    name: str | None,
    seconds: float,
    timeout_s: float,
    *,
    as_json: bool,
) -> None:
    """Print where a tool's tip is held still; a refusal ends the command with its reason."""
    with client_session(url, key) as client:
        if not as_json:
            console.print(f"Hold the tip of {tool_id} still on the point.", highlight=False)
        found = client.measure_point(
            tool_id, frame=frame, name=name, timeout_s=timeout_s, seconds=seconds
        )
    if as_json:
        print_json(found.model_dump(mode="json"))
        return
    table = Table()
    table.add_column("point")
    table.add_column("in")
    for heading in ("place [mm]", "sd [mm]", "scatter [mm]", "frames"):
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_row(
        found.name or "-", found.frame, _vector(found.position_mm), _root(found.covariance_mm2),
        f"{found.sigma_mm:.3f}", str(found.frames),
    )  # fmt: skip
    console.print(table)


def watch(
    url: str,
    key: str | None,
    device: str | None,
    frame: str | None,
    seconds: float | None,
    now: Callable[[], float] = time.monotonic,
) -> None:
    """Show the poses of all tools until the time is over."""
    end = None if seconds is None else now() + seconds
    with client_session(url, key) as client:
        if device is not None:
            client.device(device)  # to be told that there is none, not that it has no tools
        tools = client.tools(device)
        if not tools:
            raise fail("there are no tools; POST /api/v1/tools makes one (docs/how-to/tools.md)")

        def poses() -> Group:
            # In the frame of a tool that tool itself is left out: it is where it is.
            others = (tool for tool in tools if tool.id != frame)
            return _poses(client.tool_pose(tool.id, frame) for tool in others)

        try:
            with Live(poses(), console=console, auto_refresh=False) as shown:
                while end is None or now() < end:
                    time.sleep(1.0 / REFRESHES_PER_S)
                    shown.update(poses(), refresh=True)
        except KeyboardInterrupt:
            return


def _poses(poses: Iterable[Pose]) -> Group:
    """Return a table, and below it, as wide as the terminal, why poses are not OK."""
    reasons: list[Text] = []
    table = Table()
    table.add_column("tool")
    table.add_column("in")
    table.add_column("status")
    for heading in ("tip [mm]", "sd [mm]", "age [s]"):
        table.add_column(heading, justify="right", no_wrap=True)
    for pose in poses:
        style = _STYLES.get(pose.status, "red")
        table.add_row(
            pose.tool, pose.frame, f"[{style}]{pose.status}[/{style}]", _vector(pose.tip_mm),
            _deviation(pose), "-" if pose.age_s is None else f"{pose.age_s:.2f}",
        )  # fmt: skip
        if pose.reason:
            reasons.append(Text(f"{pose.tool}: {pose.reason}"))
    return Group(table, *reasons)


def _strobed(tool: Tool) -> str:
    return "-" if tool.strobe_markers is None else " ".join(map(str, tool.strobe_markers))


def _vector(values: tuple[float, float, float] | None) -> str:
    return "-" if values is None else " ".join(f"{value:9.2f}" for value in values)


def _deviation(pose: Pose) -> str:
    spread = pose.tip_covariance_mm2
    return "-" if spread is None else _root(spread)


def _root(spread: Matrix3) -> str:
    return f"{sqrt(sum(spread[n][n] for n in range(3))):.3f}"
