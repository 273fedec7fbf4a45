"""Options of the beam-hold commands: list, show, watch, acknowledge."""

from typing import Annotated

import typer

from service.cli.tools_commands import HERE, AsJson, Device, Key, Url

holds = typer.Typer(
    help="Beam holds of a running server, and whether a beam is held.", no_args_is_help=True
)

Hold = Annotated[str, typer.Argument(help="The hold's id.")]


def register(app: typer.Typer) -> None:
    """Add the commands to the command line."""
    app.add_typer(holds, name="beam-holds")


@holds.command("list")
def list_beam_holds(
    device: Device = None, url: Url = HERE, key: Key = None, as_json: AsJson = False
) -> None:
    """List beam holds, and whether each is held."""
    from service.cli.beam_holds import show_all

    show_all(url, key, device, as_json=as_json)


@holds.command("show")
def show_beam_hold(hold: Hold, url: Url = HERE, key: Key = None, as_json: AsJson = False) -> None:
    """Show a hold and its state; exit code 1 where the beam is held."""
    from service.cli.beam_holds import show_one

    show_one(url, key, hold, as_json=as_json)


@holds.command("watch")
def watch_beam_hold(
    hold: Hold,
    seconds: Annotated[
        float | None, typer.Option(min=0.1, help="How long; left out: until Ctrl-C.")
    ] = None,
    url: Url = HERE,
    key: Key = None,
    as_json: AsJson = False,
) -> None:
    """Print each change of a hold as it comes; exit code 1 where the beam is held at the end."""
    from service.cli.beam_holds import watch

    watch(url, key, hold, seconds, as_json=as_json)


@holds.command("acknowledge")
def acknowledge_beam_hold(
    hold: Hold, url: Url = HERE, key: Key = None, as_json: AsJson = False
) -> None:
    """Let a latched hold end, once all is back."""
    from service.cli.beam_holds import acknowledge

    acknowledge(url, key, hold, as_json=as_json)
