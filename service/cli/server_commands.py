"""Options of the server commands: serve, openapi, demo, reproduce, bench."""

from pathlib import Path
from typing import Annotated

import typer


def register(app: typer.Typer) -> None:
    """Add the commands to the command line."""
    app.command("serve")(serve)
    app.command("openapi")(openapi)
    app.command("demo")(demo)
    app.command("reproduce")(reproduce)
    app.command("bench")(bench)


def serve(
    host: Annotated[str | None, typer.Option(help="Address to listen on.")] = None,
    port: Annotated[int | None, typer.Option(help="Port to listen on; 0: a free one.")] = None,
    data_dir: Annotated[Path | None, typer.Option(help="Database, recordings, profiles.")] = None,
    device: Annotated[
        str | None, typer.Option(help="Start a device profile: optotrak, ..., or a TOML file.")
    ] = None,
    compute_device: Annotated[
        str | None, typer.Option(help="Where the pipeline computes: cpu, cuda:0, ...")
    ] = None,
) -> None:
    """Run the service. Options win over LUMILINE_... variables and lumiline.toml."""
    from service.cli.serve import run

    run(host=host, port=port, data_dir=data_dir, device=device, compute_device=compute_device)


def openapi() -> None:
    """Print the OpenAPI document."""
    from service.cli.openapi import run

    run()


def demo(
    output: Annotated[Path, typer.Option(help="Folder for the picture, database and log.")] = Path(
        "demo-output"
    ),
    seconds: Annotated[float, typer.Option(min=2.0, help="How long the bar is streamed.")] = 5.0,
) -> None:
    """Show the main job end to end: a real service, measured frames, a simulated device."""
    from service.cli.demo import run

    run(output, seconds)


def reproduce(
    case: Annotated[str | None, typer.Argument(help="A case's name, or all.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="For machines.")] = False,
    output: Annotated[Path | None, typer.Option(help="Draw the case's picture: a PNG.")] = None,
) -> None:
    """Run published tests: the reference figures and ours side by side. No case: list them."""
    from service.cli.reproduce import run

    run(case, as_json=as_json, output=output)


def bench(
    name: Annotated[
        str | None, typer.Argument(help="live, load, signal, points, calibration, ...")
    ] = None,
    seconds: Annotated[
        float, typer.Option(min=1.0, help="Duration of those of a running server.")
    ] = 60.0,
    rate: Annotated[float, typer.Option(min=1.0, help="Frames a second of load.")] = 5000.0,
    device: Annotated[
        str | None, typer.Option(help="cpu, cuda:0, ... for signal, reconstruct, rays.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="For machines.")] = False,
) -> None:
    """Measure speed beside the peers a user would pick instead. No name: list them."""
    from service.cli.bench import run

    run(name, seconds=seconds, rate_hz=rate, device=device, as_json=as_json)
