"""`lumiline wand`: calibrates from a wand of known length at unknown positions, offline."""

from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from compute.calibration.self_calibration.self_calibrate import self_calibrate
from compute.calibration.self_calibration.targets import Recording, Wand
from compute.calibration.self_calibration.wave_coverage import wave_coverage
from compute.camera.model import SensorGeometry, SensorModel
from compute.errors import InvalidParameter, LumilineError
from service.cli.calibrate import fit_table, parse_distortion, write_calibration
from service.cli.json_files import read_calibration
from service.cli.observations_csv import read_wand
from service.cli.output import Force, check_output, console, make_table, progress, say
from service.cli.server_session import HERE, Key, Url, client_session
from service.cli.wand_live import show_coverage, wave_live
from service.cli.wand_sources import LiveWand, read_recorded_wand

MAX_LISTED = 20
"""Largest number of rejected readings that are listed."""


def wand(
    positions: Annotated[
        str, typer.Option(help=r"Where the markers are along the wand \[mm], as '0 300'.")
    ],
    readings: Annotated[
        Path | None,
        typer.Argument(help="CSV: pose,marker,NAME_px,... Left out: --recording or --live."),
    ] = None,
    recording: Annotated[
        Path | None, typer.Option(help="Recording of line scans in which the wand is waved.")
    ] = None,
    live: Annotated[
        str | None,
        typer.Option(
            metavar="DEVICE",
            help="Running device in front of which the wand is waved; shows what it has covered "
            "and what is missing, and ends when that is enough.",
        ),
    ] = None,
    markers: Annotated[
        str,
        typer.Option(help="Of --recording and --live: the wand's strobed markers, in its order."),
    ] = "0 1",
    seconds: Annotated[
        float, typer.Option(min=1.0, max=3600.0, help="Of --live: how long at most.")
    ] = 120.0,
    start: Annotated[
        Path | None,
        typer.Option(
            help="Initial cameras: a calibration as JSON, a design's or old. Left out: from the "
            "readings, of four sensors or more."
        ),
    ] = None,
    from_readings: Annotated[
        bool,
        typer.Option(
            help="Compute the initial cameras from the readings; --start gives the frame, and "
            "which of two mirror images is right."
        ),
    ] = False,
    pixels: Annotated[
        int | None, typer.Option(min=8, help="Without --start: pixels of each sensor.")
    ] = None,
    directions: Annotated[
        str | None,
        typer.Option(
            help="Without --start: for each sensor, in the order of its column, the direction in "
            r"which its readings grow \[degrees, clockwise from the right, seen from the device "
            "towards the scene], to 20 degrees, as '90 0 45 135'; it settles the mirror image."
        ),
    ] = None,
    distortion: Annotated[
        str,
        typer.Option(
            help="Without --start: none, a set's name, or terms u^i v^j as '3,0 1,2'. With it: "
            "those of the start."
        ),
    ] = "none",
    sigma: Annotated[
        float,
        typer.Option(min=0.0, help=r"Standard deviation of these positions \[mm]; 0: exact."),
    ] = 0.0,
    output: Annotated[Path | None, typer.Option(help="Write the calibration as JSON.")] = None,
    url: Url = HERE,
    key: Key = None,
    force: Force = False,
) -> None:
    """Calibrate from a waved wand; print the fit and what was left out, write it as JSON."""
    check_output(output, force=force)
    target = Wand(_positions(positions), sigma)
    if (readings is not None) + (recording is not None) + (live is not None) != 1:
        raise InvalidParameter(
            "give the wand's readings once: a CSV file, --recording with a file, or --live with a "
            "device"
        )
    strobed = _markers(markers)
    if readings is None and len(strobed) != len(target):
        raise InvalidParameter(
            f'markers is "{markers}"; the wand has {len(target)}: give the strobed marker of each'
        )
    cameras = None if start is None else read_calibration(start).calibration.models
    if cameras is not None and pixels is not None:
        raise InvalidParameter("--pixels is given with --start, whose cameras have theirs")
    sensors: tuple[SensorGeometry, ...] | None = None
    if readings is not None:
        table = read_wand(readings, len(target))
        if cameras is None and pixels is not None:
            sensors = tuple(SensorGeometry(name, pixels) for name in table.sensors)
    elif recording is not None:
        with progress("finding peaks", 1.0) as report:
            table, sensors = read_recorded_wand(recording, strobed, report)
    else:
        assert live is not None
        with client_session(url, key) as client:
            source = LiveWand(client, live, strobed)
            sensors = source.sensors
            table = wave_live(source, target, cameras, seconds)
    initial: tuple[SensorModel, ...] | tuple[SensorGeometry, ...]
    if cameras is not None:
        initial = cameras
        table = table.in_order_of(cameras, str(start))
    elif sensors is None:
        raise InvalidParameter(
            "no initial cameras: give --start with a calibration, or --pixels of each sensor and "
            "--directions to calibrate from the readings alone"
        )
    else:
        initial = sensors
    waved = Recording(target, table.readings_px, table.sigma_px)
    try:
        with progress("calibrating", 1.0) as report:
            result = self_calibrate(
                initial,
                [waved],
                initial="readings" if from_readings or start is None else "start",
                directions_deg=(
                    None if directions is None else _directions(directions, table.sensors)
                ),
                distortion=parse_distortion(distortion),
                progress=lambda share, _stage: report(share),
            )
    except LumilineError:
        if readings is None:
            show_coverage(wave_coverage(initial, waved, cameras))
        raise
    if readings is None:
        show_coverage(wave_coverage(initial, waved, result.calibration.models))
    fit = result.targets[0]
    console.print(fit_table(result.calibration, f"{table.path}: {fit.used} of {fit.poses} poses"))
    if fit.length_error_mm is not None:
        span = float(np.ptp(np.array(target.position_mm)))
        say(f"the wand of {span:g} mm, marker by marker: {fit.length_error_mm:.3g} mm RMS off")
    say(f"chi2 {result.chi2_per_dof:.3g} a degree of freedom")
    if result.device_scale is not None:
        say(f"the device is {result.device_scale:.4g} times as large as in {start}")
    for warning in result.warnings:
        console.print(f"WARNING: {warning}", style="bold red", markup=False, highlight=False)
    for one in result.exchanged:
        say(
            f"pose {one.pose}: the readings of markers {one.first} and {one.second} of "
            f"{one.sensor} were exchanged; they were exchanged back"
        )
    if result.rejected:
        rows = (
            (one.pose, one.marker, one.sensor, f"{one.normalised_residual:.1f}")
            for one in result.rejected[:MAX_LISTED]
        )
        headings = ("pose", "marker", "sensor", "residual / sigma")
        title = f"{len(result.rejected)} readings left out"
        console.print(make_table(headings, rows, title, texts=None))
    if output is not None:
        write_calibration(output, result.calibration)


def _directions(text: str, sensors: tuple[str, ...]) -> list[float]:
    """Return an angle [degrees] for each sensor; raises InvalidParameter."""
    try:
        angles = [float(part) for part in text.replace(",", " ").split()]
    except ValueError:
        angles = []
    if len(angles) != len(sensors):
        raise InvalidParameter(
            f'directions is "{text}"; it must be an angle in degrees for each of '
            f"{', '.join(sensors)}, in this order",
            directions=text,
        )
    return angles


def _markers(text: str) -> list[int]:
    """Return numbers of strobed markers; raises InvalidParameter."""
    try:
        return [int(part) for part in text.replace(",", " ").split()]
    except ValueError:
        raise InvalidParameter(
            f'markers is "{text}"; it must be the numbers of the strobed markers, such as "0 1"'
        ) from None


def _positions(text: str) -> tuple[float, ...]:
    """Return the markers' positions; raises InvalidParameter."""
    try:
        return tuple(float(part) for part in text.replace(",", " ").split())
    except ValueError:
        raise InvalidParameter(
            f'positions is "{text}"; it must be the markers\' positions along the wand in mm, '
            'for example "0 300"'
        ) from None
