"""Options of the recording commands: record, replay, export, simulate-serial.

Their options only."""

from pathlib import Path
from typing import Annotated

import typer


def register(app: typer.Typer) -> None:
    """Add the commands to the command line."""
    app.command("record")(record)
    app.command("replay")(replay)
    app.command("export")(export_motion)
    app.command("simulate-serial")(simulate_serial)


def record(
    output: Annotated[Path, typer.Argument(help="HDF5 file to write.")],
    seconds: Annotated[float, typer.Option(min=0.001, help="Duration.")] = 5.0,
    settings: Annotated[
        Path | None, typer.Option(help="Simulation settings as JSON, as in a device's source.")
    ] = None,
    device: Annotated[
        str | None, typer.Option(help="A device profile: optotrak, ..., or a TOML file.")
    ] = None,
) -> None:
    """Record line scans of the simulated bar, or of a profile's device, to a file."""
    from service.cli.record_offline import run_record

    run_record(output, seconds, settings, device)


def replay(
    recording: Annotated[Path, typer.Argument(help="HDF5 file of a recording.")],
    calibration: Annotated[
        Path | None,
        typer.Option(help="Calibration as JSON, from `calibrate`; left out: the recorded ones."),
    ] = None,
    table: Annotated[
        Path | None, typer.Option(help="Correction table (HDF5) of that calibration.")
    ] = None,
    output: Annotated[Path | None, typer.Option(help="File; left out: standard output.")] = None,
    check: Annotated[
        bool, typer.Option("--check", help="Compare with the recorded results, bit by bit.")
    ] = False,
    batch: Annotated[
        int, typer.Option(min=1, max=64, help="Frames that are processed together.")
    ] = 64,
    as_json: Annotated[bool, typer.Option("--json", help="Of --check, for machines.")] = False,
) -> None:
    """Reconstruct a recording: one JSON message a frame, as the stream sends them."""
    from service.cli.replay_offline import run_check, run_replay

    if check:
        run_check(recording, batch, as_json=as_json)
    else:
        run_replay(recording, calibration, table, output)


def export_motion(
    source: Annotated[
        Path, typer.Argument(help="A recording (HDF5), or a stream's JSON messages (.jsonl).")
    ],
    to: Annotated[Path, typer.Option("--to", help="File: .c3d, .trc, .csv, .parquet or .igs.mha.")],
    tools: Annotated[
        Path | None, typer.Option(help="Tools as JSON, as GET /api/v1/tools sends them.")
    ] = None,
    device: Annotated[
        Path | None,
        typer.Option(
            help="The device as JSON, as GET /api/v1/devices/{id} sends it: its `tracking`, and "
            "only its tools; left out: defaults, and all tools."
        ),
    ] = None,
    calibration: Annotated[
        Path | None,
        typer.Option(help="Calibration as JSON, from `calibrate`; left out: the recorded ones."),
    ] = None,
    table: Annotated[
        Path | None, typer.Option(help="Correction table (HDF5) of that calibration.")
    ] = None,
    predicted: Annotated[
        bool, typer.Option("--predicted", help="C3D, TRC: no gaps where tracks are predicted.")
    ] = False,
    points: Annotated[
        bool, typer.Option("--points", help="C3D, TRC: strobed markers' points, not tracks.")
    ] = False,
) -> None:
    """Write points, tracks and tool poses for other programs: C3D, TRC, CSV, Parquet, PLUS."""
    from service.cli.export import ExportOptions, run

    run(source, to, ExportOptions(tools, calibration, table, predicted, points, device))


def simulate_serial(
    listen: Annotated[str | None, typer.Option(help="HOST:PORT to be reached at.")] = None,
    pty: Annotated[bool, typer.Option("--pty", help="Be a pseudo-terminal instead.")] = False,
    link: Annotated[
        Path | None, typer.Option(help="Of a pseudo-terminal: a symbolic link to make.")
    ] = None,
    rate: Annotated[float | None, typer.Option(help="Exposures per second.")] = None,
    cycle: Annotated[
        int | None, typer.Option(min=1, help="Number of exposures to render and repeat.")
    ] = None,
    part: Annotated[
        int | None, typer.Option(min=1, help="Counts in a message; left out: an exposure's all.")
    ] = None,
    settings: Annotated[
        Path | None, typer.Option(help="Simulation settings as JSON, as in a device's source.")
    ] = None,
) -> None:
    """Be a device that speaks the line-scan protocol, in a process of its own."""
    from service.cli.simulate_serial import run

    run(listen, terminal=pty, link=link, rate_hz=rate, cycle=cycle, part=part, settings=settings)
