"""Options of the tool commands: list, show, watch, create, capture, point."""

from pathlib import Path
from typing import Annotated

import typer

tools = typer.Typer(help="Tools of a running server, and where they are.", no_args_is_help=True)

Url = Annotated[str, typer.Option(envvar="LUMILINE_URL", help="The server.", show_default=True)]
Key = Annotated[
    str | None,
    typer.Option(envvar="LUMILINE_KEY", help="API key; better in the variable than here."),
]
Device = Annotated[str | None, typer.Option(help="Only those of this device.")]
Frame = Annotated[
    str | None,
    typer.Option(help="tracker, a tool, or a registration; left out: each tool's reference."),
]
AsJson = Annotated[bool, typer.Option("--json", help="For machines.")]
HERE = "http://127.0.0.1:8000"


def register(app: typer.Typer) -> None:
    """Add the commands to the command line."""
    app.add_typer(tools, name="tools")


@tools.command("list")
def list_tools(
    device: Device = None, url: Url = HERE, key: Key = None, as_json: AsJson = False
) -> None:
    """List tools."""
    from service.cli.tools import show_all

    show_all(url, key, device, as_json=as_json)


@tools.command("show")
def show_tool(
    tool: Annotated[str, typer.Argument(help="The tool's id.")],
    frame: Frame = None,
    url: Url = HERE,
    key: Key = None,
    as_json: AsJson = False,
) -> None:
    """Show a tool and its newest pose; exit code 1 where that is not OK."""
    from service.cli.tools import show_one

    show_one(url, key, tool, frame, as_json=as_json)


@tools.command("watch")
def watch_tools(
    device: Device = None,
    frame: Frame = None,
    seconds: Annotated[
        float | None, typer.Option(min=0.1, help="How long; left out: until Ctrl-C.")
    ] = None,
    url: Url = HERE,
    key: Key = None,
) -> None:
    """Show where all tools are, several times a second."""
    from service.cli.tools import watch

    watch(url, key, device, frame, seconds)


@tools.command("create")
def create_tools(
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
    from service.cli.tool_files import create

    create(file, device, tool_id, url, key, as_json=as_json)


@tools.command("capture")
def capture_tool(
    tool: Annotated[str, typer.Argument(help="The id that it gets.")],
    device: Annotated[str, typer.Option(help="The running device that sees it.")],
    markers: Annotated[
        int | None, typer.Option(help="How many it has, lit together; nothing else is lit.")
    ] = None,
    strobe_markers: Annotated[
        str | None, typer.Option(help="Its slots, lit one by one: 0,1,2,3.")
    ] = None,
    seconds: Annotated[float, typer.Option(min=0.05, max=60.0, help="How long to look.")] = 1.0,
    title: Annotated[str | None, typer.Option(help="For people.")] = None,
    url: Url = HERE,
    key: Key = None,
    as_json: AsJson = False,
) -> None:
    """Make a tool by showing it: hold it still until this answers."""
    from service.cli.tool_files import capture

    capture(tool, device, markers, strobe_markers, seconds, title, url, key, as_json=as_json)


@tools.command("point")
def measure_point(
    tool: Annotated[str, typer.Argument(help="The tool's id.")],
    frame: Frame = None,
    name: Annotated[str | None, typer.Option(help="Of the point, for the answer.")] = None,
    seconds: Annotated[
        float, typer.Option(min=0.05, max=10.0, help="How long the tip has to be still.")
    ] = 0.5,
    timeout: Annotated[float, typer.Option(min=0.1, max=120.0, help="How long to wait [s].")] = 30,
    url: Url = HERE,
    key: Key = None,
    as_json: AsJson = False,
) -> None:
    """Measure a point: hold the tool's tip on it until this answers."""
    from service.cli.tools import measure

    measure(url, key, tool, frame, name, seconds, timeout, as_json=as_json)
