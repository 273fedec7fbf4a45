"""`lumiline tools`: tools of a running server and their poses, through the client."""

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from math import sqrt
from typing import Annotated, Final

import typer
from rich.console import Group
from rich.live import Live
from rich.text import Text

from lumiline.client.models import Pose
from service.cli.options import HERE, AsJson, DeviceOption, Key, Url, WatchSeconds
from service.cli.output import (
    console,
    fail,
    hint,
    make_table,
    print_json,
    progress,
    say,
    spec,
)
from service.cli.server_session import client_session
from service.cli.tool_files import capture, create

REFRESHES_PER_S: Final = 5.0
_STYLES: Final = {
    "OK": "green",
    "LOW_RELIABILITY": "yellow",
    "HIGH_ERROR": "yellow",
    "OUT_OF_VOLUME": "yellow",
}

tools = typer.Typer(
    help="Tools of a running server, and where they are.",
    no_args_is_help=True,
    add_completion=False,
)

ToolId = Annotated[str, typer.Argument(help="The tool's id.")]
Frame = Annotated[
    str | None,
    typer.Option(help="tracker, a tool, or a registration; left out: each tool's reference."),
]


@tools.command("list")
def show_all(
    device: DeviceOption = None, url: Url = HERE, key: Key = None, as_json: AsJson = False
) -> None:
    """List tools."""
    with client_session(url, key) as client:
        listed = client.tools(device_id=device)
    if as_json:
        print_json(listed)
        return
    rows = (
        (
            tool.id, tool.device_id, tool.title, len(tool.markers_mm),
            None if tool.strobe_markers is None else " ".join(map(str, tool.strobe_markers)),
            _vector(tool.tip.position_mm), tool.reference_id or "tracker",
        )
        for tool in listed
    )  # fmt: skip
    headings = ("id", "device", "title", "markers", "strobed", "tip [mm]", "relative to")
    console.print(make_table(headings, rows, texts=None))


@tools.command("show")
def show_one(
    tool: ToolId, frame: Frame = None, url: Url = HERE, key: Key = None, as_json: AsJson = False
) -> None:
    """Show a tool and its newest pose; exit code 1 where that is not OK."""
    with client_session(url, key) as client:
        document, pose = client.tool(tool), client.tool_pose(tool, frame_id=frame)
    if as_json:
        print_json({"tool": document, "pose": pose})
    else:
        say(f"{document.id}: {document.title}, {len(document.markers_mm)} markers")
        console.print(_poses([pose]))
    if pose.status != "OK":
        raise typer.Exit(1)


@tools.command("watch")
def watch(
    device: DeviceOption = None,
    frame: Frame = None,
    seconds: WatchSeconds = None,
    url: Url = HERE,
    key: Key = None,
    as_json: AsJson = False,
) -> None:
    """Show where all tools are, several times a second; as JSON a pose in each line."""
    end = None if seconds is None else time.monotonic() + seconds
    with client_session(url, key) as client:
        if device is not None:
            client.device(device)  # to be told that there is none, not that it has no tools
        watched = client.tools(device_id=device)
        if not watched:
            raise fail("there are no tools; POST /api/v1/tools makes one (docs/how-to/tools.md)")

        def poses() -> Iterator[Pose]:
            # In the frame of a tool that tool itself is left out: it is where it is.
            others = (tool for tool in watched if tool.id != frame)
            return (client.tool_pose(tool.id, frame_id=frame) for tool in others)

        with suppress(KeyboardInterrupt), _shown(as_json=as_json) as show:
            show(poses())
            while end is None or time.monotonic() < end:
                time.sleep(1.0 / REFRESHES_PER_S)
                show(poses())


@contextmanager
def _shown(*, as_json: bool) -> Iterator[Callable[[Iterable[Pose]], None]]:
    """Yield a function that shows the newest poses in place of those before, or prints them."""
    if as_json:

        def print_lines(poses: Iterable[Pose]) -> None:
            for pose in poses:
                typer.echo(pose.model_dump_json())

        yield print_lines
        return
    with Live(console=console, auto_refresh=False) as live:
        yield lambda poses: live.update(_poses(poses), refresh=True)


tools.command("create")(create)
tools.command("capture")(capture)


@tools.command("point")
def measure(
    tool: ToolId,
    frame: Frame = None,
    name: Annotated[str | None, typer.Option(help="Of the point, for the answer.")] = None,
    seconds: Annotated[
        float, typer.Option(min=0.05, max=10.0, help="How long the tip has to be still.")
    ] = 0.5,
    timeout_s: Annotated[
        float, typer.Option(min=0.1, max=120.0, help=r"How long to wait \[s].")
    ] = 30,
    url: Url = HERE,
    key: Key = None,
    as_json: AsJson = False,
) -> None:
    """Measure a point: hold the tool's tip on it until this answers."""
    with client_session(url, key) as client, progress("waiting for a still tip"):
        hint(f"Hold the tip of {tool} still on the point.")
        point = client.measure_point(
            tool, frame_id=frame, name=name, timeout_s=timeout_s, duration_s=seconds
        )
    if as_json:
        print_json(point)
        return
    row = (
        point.name or None, point.frame_id, _vector(point.position_mm),
        _sigma(point.covariance_mm2), f"{point.sigma_mm:.3f}", point.frames,
    )  # fmt: skip
    headings = ("point", "in", "position [mm]", "sd [mm]", "scatter [mm]", "frames")
    console.print(make_table(headings, [row], texts=2, no_wrap=True))


def _poses(poses: Iterable[Pose]) -> Group:
    """Return a table, and below it, as wide as the terminal, why poses are not OK."""
    rows, reasons = [], []
    for pose in poses:
        style = _STYLES.get(pose.status, "red")
        rows.append((
            pose.tool_id, pose.frame_id, f"[{style}]{pose.status}[/{style}]", _vector(pose.tip_mm),
            _sigma(pose.tip_covariance_mm2), spec(pose.age_s, ".2f"),
        ))  # fmt: skip
        if pose.reason:
            reasons.append(Text(f"{pose.tool_id}: {pose.reason}"))
    headings = ("tool", "in", "status", "tip [mm]", "sd [mm]", "age [s]")
    return Group(make_table(headings, rows, texts=3, no_wrap=True), *reasons)


def _vector(values: Sequence[float] | None) -> str | None:
    return None if values is None else " ".join(f"{value:9.2f}" for value in values)


def _sigma(covariance: Sequence[Sequence[float]] | None) -> str | None:
    """Return the root of the summed variances of a position."""
    if covariance is None:
        return None
    return f"{sqrt(sum(covariance[axis][axis] for axis in range(3))):.3f}"
