"""Options of the offline calibration commands: calibrate, wand, map, drift."""

from pathlib import Path
from typing import Annotated

import typer


def register(app: typer.Typer) -> None:
    """Add the commands to the command line."""
    app.command("calibrate")(calibrate)
    app.command("wand")(wand)
    app.command("map")(map_volume)
    app.command("drift")(drift)


def calibrate(
    observations: Annotated[Path, typer.Argument(help="CSV: X_mm,Y_mm,Z_mm,NAME_px,...")],
    pixels: Annotated[int, typer.Option(min=8, help="Pixels of each sensor.")],
    pitch: Annotated[
        float | None, typer.Option(min=0.01, help="Pixel pitch \\[um]; helps wide-field lenses.")
    ] = None,
    distortion: Annotated[
        str,
        typer.Option(
            help="none, auto (by cross-validation), a set's name, or terms u^i v^j as '3,0 1,2'."
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

    options = CalibrateOptions(pixels, pitch, distortion, control_sigma, loss, labels)
    run(observations, options, output, report, report_figures)


def wand(
    readings: Annotated[Path, typer.Argument(help="CSV: pose,marker,NAME_px,...")],
    start: Annotated[
        Path, typer.Option(help="Nearly right cameras: a calibration as JSON, a design's or old.")
    ],
    positions: Annotated[
        str, typer.Option(help=r"Where the markers are along the wand \[mm], as '0 300'.")
    ],
    sigma: Annotated[
        float, typer.Option(min=0.0, help=r"Deviation of these places \[mm]; 0: exact.")
    ] = 0.0,
    output: Annotated[Path | None, typer.Option(help="Write the calibration as JSON.")] = None,
) -> None:
    """Calibrate from a wand waved through the volume: no known coordinates, one known length."""
    from service.cli.wand import run

    run(readings, start, positions, sigma, output)


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
    penalty_weight: Annotated[
        float | None, typer.Option(help="Weight of the penalty; left out: by cross-validation.")
    ] = None,
    point_sigma: Annotated[
        float, typer.Option(min=0.0, help=r"Deviation of the points' coordinates \[mm].")
    ] = 0.0,
    calibration_points: Annotated[
        bool,
        typer.Option("--calibration-points", help="They are the calibration's own control points."),
    ] = False,
) -> None:
    """Map a volume: corrections of the readings where the calibrated cameras are wrong."""
    from service.cli.map_volume import MapOptions, run

    options = MapOptions(method, pitch, penalty_weight, point_sigma, calibration_points)
    run(measurements, calibration, options, output)


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
