"""The command line `lumiline`: one command per job, each in its own module of this package.

A command's module is imported when the command runs, so that `lumiline --help` stays quick.
"""

from pathlib import Path
from typing import Annotated

import typer

from service.cli.administration import register
from service.cli.marker_commands import register as register_markers
from service.cli.tools_commands import register as register_tools
from service.version import package_version

app = typer.Typer(
    name="lumiline",
    help="Tracking server for linear (1D) optical sensors.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_show_locals=False,
)


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(package_version())
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_version, is_eager=True, help="Print the version."),
    ] = False,
) -> None:
    """Tracking server for linear (1D) optical sensors."""


@app.command()
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


@app.command()
def openapi() -> None:
    """Print the OpenAPI document."""
    from service.cli.openapi import run

    run()


@app.command()
def demo(
    output: Annotated[Path, typer.Option(help="Folder for the picture, database and log.")] = Path(
        "demo-output"
    ),
    seconds: Annotated[float, typer.Option(min=2.0, help="How long the bar is streamed.")] = 5.0,
) -> None:
    """Show the main job end to end: a real service, measured frames, a simulated device."""
    from service.cli.demo import run

    run(output, seconds)


@app.command()
def reproduce(
    case: Annotated[str | None, typer.Argument(help="A case's name, or all.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="For machines.")] = False,
    output: Annotated[Path | None, typer.Option(help="Draw the case's picture: a PNG.")] = None,
) -> None:
    """Run published tests: the reference figures and ours side by side. No case: list them."""
    from service.cli.reproduce import run

    run(case, as_json=as_json, output=output)


@app.command()
def bench(
    name: Annotated[
        str | None, typer.Argument(help="live, load, signal, points, calibration, ...")
    ] = None,
    seconds: Annotated[float, typer.Option(min=1.0, help="Duration of live, load.")] = 60.0,
    rate: Annotated[float, typer.Option(min=1.0, help="Frames a second of load.")] = 5000.0,
    device: Annotated[
        str | None, typer.Option(help="cpu, cuda:0, ... for signal, reconstruct, rays.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="For machines.")] = False,
) -> None:
    """Measure speed beside the peers a user would pick instead. No name: list them."""
    from service.cli.bench import run

    run(name, seconds=seconds, rate_hz=rate, device=device, as_json=as_json)


@app.command()
def calibrate(
    observations: Annotated[Path, typer.Argument(help="CSV: X_mm,Y_mm,Z_mm,NAME_px,...")],
    pixels: Annotated[int, typer.Option(min=8, help="Pixels of each sensor.")],
    pitch: Annotated[
        float | None, typer.Option(min=0.01, help="Pixel pitch \\[um]; helps wide-field lenses.")
    ] = None,
    method: Annotated[
        str, typer.Option(help="metric; or the published dlt-iterative, bundle-11.")
    ] = "metric",
    distortion: Annotated[
        str,
        typer.Option(
            help="Of metric: none, auto (by cross-validation), a set's name, or terms u^i v^j as "
            "'3,0 1,2'."
        ),
    ] = "auto",
    control_sigma: Annotated[
        float | None, typer.Option(help=r"Deviation of the control points' coordinates \[mm].")
    ] = None,
    loss: Annotated[str, typer.Option(help="linear or robust.")] = "linear",
    labels: Annotated[
        str, typer.Option(help="Wrong and exchanged labels: off, report, exclude or repair.")
    ] = "report",
    output: Annotated[Path | None, typer.Option(help="Write the calibration as JSON.")] = None,
    report: Annotated[Path | None, typer.Option(help="Write a report: an HTML file.")] = None,
    report_figures: Annotated[
        Path | None, typer.Option(help="Folder for the report's figures as PNG.")
    ] = None,
) -> None:
    """Calibrate from a CSV file of control points and readings, without a server."""
    from service.cli.calibrate import CalibrateOptions, run

    options = CalibrateOptions(pixels, pitch, method, distortion, control_sigma, loss, labels)
    run(observations, options, output, report, report_figures)


@app.command()
def wand(
    readings: Annotated[Path, typer.Argument(help="CSV: pose,marker,NAME_px,...")],
    start: Annotated[
        Path, typer.Option(help="Nearly right cameras: a calibration as JSON, a design's or old.")
    ],
    places: Annotated[
        str, typer.Option(help=r"Where the markers are along the wand \[mm], as '0 300'.")
    ],
    sigma: Annotated[
        float, typer.Option(min=0.0, help=r"Deviation of these places \[mm]; 0: exact.")
    ] = 0.0,
    output: Annotated[Path | None, typer.Option(help="Write the calibration as JSON.")] = None,
) -> None:
    """Calibrate from a wand waved through the volume: no known coordinates, one known length."""
    from service.cli.wand import run

    run(readings, start, places, sigma, output)


@app.command("map")
def map_volume(
    measurements: Annotated[Path, typer.Argument(help="CSV: X_mm,Y_mm,Z_mm,NAME_px,...")],
    calibration: Annotated[
        Path, typer.Option(help="Calibration as JSON, from `calibrate` or the service.")
    ],
    output: Annotated[Path, typer.Option(help="HDF5 file of the table to write.")],
    method: Annotated[
        str, typer.Option(help="b-spline for points anywhere; trilinear, tricubic for a grid.")
    ] = "b-spline",
    pitch: Annotated[
        float | None, typer.Option(help=r"Edge of a cell \[mm]; left out: from the points.")
    ] = None,
    smoothness: Annotated[
        float | None, typer.Option(help="Weight of the penalty; left out: by cross-validation.")
    ] = None,
    point_sigma: Annotated[
        float, typer.Option(min=0.0, help=r"Deviation of the points' coordinates \[mm].")
    ] = 0.0,
    own_points: Annotated[
        bool, typer.Option("--own-points", help="They are the calibration's own control points.")
    ] = False,
) -> None:
    """Map a volume: corrections of the readings where the calibrated cameras are wrong."""
    from service.cli.map_volume import MapOptions, run

    options = MapOptions(method, pitch, smoothness, point_sigma, own_points)
    run(measurements, calibration, options, output)


@app.command()
def drift(
    markers: Annotated[
        Path, typer.Argument(help="CSV of still markers, read now: X_mm,Y_mm,Z_mm,NAME_px,...")
    ],
    calibration: Annotated[
        Path, typer.Option(help="Calibration as JSON, from `calibrate` or the service.")
    ],
    earlier: Annotated[
        Path | None,
        typer.Option(help="CSV of the same markers as they read when it was made: finer."),
    ] = None,
    position_sigma: Annotated[
        float, typer.Option(min=0.0, help=r"Deviation of the markers' coordinates \[mm].")
    ] = 0.0,
    output: Annotated[
        Path | None, typer.Option(help="Write the calibration, brought up to date, as JSON.")
    ] = None,
    sensors: Annotated[
        str | None, typer.Option(help="Sensors that may have changed, as 'A,B'; left out: all.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="For machines.")] = False,
) -> None:
    """Check whether a calibration still holds; exit code 1 where it does not. Quickly update it."""
    from service.cli.drift import DriftOptions, run

    options = DriftOptions(position_sigma, sensors, as_json)
    run(markers, calibration, earlier, options, output)


@app.command()
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
    from service.cli.offline import run_record

    run_record(output, seconds, settings, device)


@app.command()
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
    from service.cli.replay import run_check, run_replay

    if check:
        run_check(recording, batch, as_json=as_json)
    else:
        run_replay(recording, calibration, table, output)


@app.command("export")
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


@app.command("simulate-serial")
def simulate_serial(
    listen: Annotated[str | None, typer.Option(help="HOST:PORT to be reached at.")] = None,
    pty: Annotated[bool, typer.Option("--pty", help="Be a pseudo-terminal instead.")] = False,
    link: Annotated[
        Path | None, typer.Option(help="Of a pseudo-terminal: a symbolic link to make.")
    ] = None,
    rate: Annotated[float | None, typer.Option(help="Exposures per second.")] = None,
    cycle: Annotated[
        int | None, typer.Option(min=1, help="Render so many exposures and repeat them.")
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


@app.command()
def cameras(as_json: Annotated[bool, typer.Option("--json", help="For machines.")] = False) -> None:
    """List the GenICam cameras that can be seen from here; needs the library Aravis."""
    from service.cli.cameras import run

    run(as_json=as_json)


@app.command()
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


@app.command()
def peaks(
    file: Annotated[
        Path, typer.Argument(help="CSV (one line of counts a row), .npy (L, P), or a recording.")
    ],
    line: Annotated[int | None, typer.Option(min=0, help="Only this line, from 0.")] = None,
    frame: Annotated[int | None, typer.Option(min=0, help="Of a recording, from 0.")] = None,
    sensor: Annotated[str | None, typer.Option(help="Of a recording: only this one.")] = None,
    method: Annotated[
        str | None,
        typer.Option(help="centroid, fit, chain or matched; left out: the recording's, or fit."),
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
        line=line,
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


register(app)
register_markers(app)
register_tools(app)


def main() -> None:
    """Run the command line."""
    app()
