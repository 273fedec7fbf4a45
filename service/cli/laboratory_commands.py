"""Options of the laboratory commands: cameras, plan, peaks, blink-codes."""

from pathlib import Path
from typing import Annotated

import typer


def register(app: typer.Typer) -> None:
    """Add the commands to the command line."""
    app.command("cameras")(cameras)
    app.command("plan")(plan)
    app.command("peaks")(peaks)
    app.command("blink-codes")(blink_codes)


def cameras(as_json: Annotated[bool, typer.Option("--json", help="For machines.")] = False) -> None:
    """List the GenICam cameras that can be seen from here; needs the library Aravis."""
    from service.cli.cameras import run

    run(as_json=as_json)


def plan(
    profile: Annotated[
        str | None, typer.Argument(help="A device profile's name, or its TOML file.")
    ] = None,
    grid: Annotated[
        int, typer.Option(min=3, max=21, help="Points of the volume along each axis.")
    ] = 5,
    markers: Annotated[
        int | None,
        typer.Option(min=1, max=64, help="Most markers to count ghosts for."),
    ] = None,
    output: Annotated[Path | None, typer.Option(help="Draw the plan: a PNG to write.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="For machines.")] = False,
) -> None:
    """Work out what a device will reach: precision, coverage, rates, ghosts. No name: list them."""
    from service.cli.plan import run

    run(profile, grid=grid, markers=markers, output=output, as_json=as_json)


def peaks(
    file: Annotated[
        Path, typer.Argument(help="CSV (one line of counts a row), .npy (L, P), or a recording.")
    ],
    scan: Annotated[int | None, typer.Option(min=0, help="Only this line, from 0.")] = None,
    frame: Annotated[int | None, typer.Option(min=0, help="Of a recording, from 0.")] = None,
    sensor: Annotated[str | None, typer.Option(help="Of a recording: only this one.")] = None,
    method: Annotated[
        str | None,
        typer.Option(
            help="centroid, fit, chain, matched or mask; left out: the recording's, or fit."
        ),
    ] = None,
    width: Annotated[
        float | None, typer.Option(help="Deviation of the lines \\[px]: fit, matched.")
    ] = None,
    further_peaks: Annotated[
        bool | None, typer.Option(help="Fit: more peaks than are seen; left out: with a width.")
    ] = None,
    settings: Annotated[
        Path | None, typer.Option(help="Method and settings as JSON, as REST takes them.")
    ] = None,
    gain: Annotated[float | None, typer.Option(help="Electrons per count.")] = None,
    read_noise: Annotated[float | None, typer.Option(help="Read noise, electrons.")] = None,
    offset: Annotated[float | None, typer.Option(help="The count without light.")] = None,
    full_scale: Annotated[int | None, typer.Option(help="The count of a saturated pixel.")] = None,
    output: Annotated[
        Path | None, typer.Option(help="Draw the (first) line: a PNG to write.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="For machines.")] = False,
    detail: Annotated[
        bool, typer.Option("--detail", help="In JSON: also model, residuals, steps.")
    ] = False,
) -> None:
    """Find the peaks of line scans. Noise that is not given is guessed, or the recording's."""
    from service.cli.peaks import run

    noise = {
        "electrons_per_count": gain,
        "read_noise_electrons": read_noise,
        "offset_counts": offset,
        "full_scale_counts": full_scale,
    }
    run(
        file,
        scan=scan,
        frame=frame,
        sensor=sensor,
        method=method,
        width_px=width,
        further_peaks=further_peaks,
        settings=settings,
        noise=noise,
        output=output,
        as_json=as_json,
        detail=detail,
    )


def blink_codes(
    markers: Annotated[int, typer.Option(min=1, max=64, help="How many markers.")] = 4,
    bits: Annotated[int, typer.Option(min=5, max=20, help="Exposures of a word.")] = 12,
    distance: Annotated[
        int, typer.Option(min=3, help="Bits in which any two differ, at least, in any phase.")
    ] = 3,
    as_json: Annotated[bool, typer.Option("--json", help="The words only.")] = False,
) -> None:
    """Make the words that markers blink, for a device's `tracking.blinking`."""
    from service.cli.blink_codes import run

    run(markers, bits, distance, as_json=as_json)
