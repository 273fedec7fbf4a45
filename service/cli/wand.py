"""`lumiline wand`: calibrates from a wand of known length at unknown positions, offline."""

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from compute.calibration.self_calibration.held_out_lengths import HeldOutLengths, held_out_lengths
from compute.calibration.self_calibration.result import SelfCalibration
from compute.calibration.self_calibration.self_calibrate import self_calibrate
from compute.calibration.self_calibration.targets import Recording, Wand
from compute.calibration.self_calibration.wave_coverage import wave_coverage
from compute.errors import InvalidParameter, LumilineError
from service.cli.calibrate import fit_table, parse_distortion, write_calibration
from service.cli.json_files import DOCUMENT, read_calibration
from service.cli.observations_csv import read_wand
from service.cli.options import (
    HERE,
    AsJson,
    Force,
    Key,
    PositionSigma,
    StrobeMarkers,
    Url,
    numbers,
    refuse_unused,
)
from service.cli.output import check_output, console, make_table, print_json, progress, say
from service.cli.sensor_geometry import PixelsOption, SensorsOption, with_geometry
from service.cli.server_session import client_session
from service.cli.wand_live import show_coverage, wave_live
from service.cli.wand_sources import LiveWand, read_recorded_wand

if TYPE_CHECKING:
    from compute.camera.model import SensorGeometry, SensorModel

CALIBRATION_SHARE = 0.8
MAX_LISTED = 20
"""Largest number of rejected readings that are listed."""


def wand(
    context: typer.Context,
    positions: Annotated[
        str, typer.Option(help=r"Where the markers are along the wand \[mm], as '0 300'.")
    ],
    readings: Annotated[
        Path | None,
        typer.Argument(help="CSV: pose,marker,NAME_px,... Left out: --recording or --device."),
    ] = None,
    recording: Annotated[
        Path | None, typer.Option(help="Recording of line scans in which the wand is waved.")
    ] = None,
    device: Annotated[
        str | None,
        typer.Option(
            help="Running device in front of which the wand is waved; shows what it has covered "
            "and what is missing, and ends when that is enough.",
        ),
    ] = None,
    strobe_markers: StrobeMarkers = None,
    seconds: Annotated[
        float, typer.Option(min=1.0, max=3600.0, help="With --device: how long at most.")
    ] = 120.0,
    calibration: Annotated[
        Path | None,
        typer.Option(
            help="Initial cameras: a calibration as JSON, a design's or old. Left out: from the "
            "readings, of four sensors or more."
        ),
    ] = None,
    from_readings: Annotated[
        bool,
        typer.Option(
            "--from-readings",
            help="Compute the initial cameras from the readings; --calibration gives the frame, "
            "and which of two mirror images is right.",
        ),
    ] = False,
    sensors: SensorsOption = None,
    pixels: PixelsOption = None,
    directions: Annotated[
        str | None,
        typer.Option(
            help="Without --calibration: for each sensor, in the order of --sensors or else of the "
            r"columns, the direction in which its readings grow \[degrees, clockwise from the "
            "right, seen from the device towards the scene], to 20 degrees, as '90 0 45 135'; it "
            "settles the mirror image."
        ),
    ] = None,
    distortion: Annotated[
        str,
        typer.Option(
            help="Without --calibration: none, a set's name, or terms u^i v^j as '3,0 1,2'. With "
            "it: its own."
        ),
    ] = "none",
    position_sigma: PositionSigma = 0.0,
    output: Annotated[Path | None, typer.Option(help="Write the calibration as JSON.")] = None,
    url: Url = HERE,
    key: Key = None,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Calibrate from a waved wand; print the fit and what was left out, write it as JSON."""
    check_output(output, force=force)
    if (readings is not None) + (recording is not None) + (device is not None) != 1:
        raise InvalidParameter(
            "give the wand's readings once: a CSV file, --recording with a file, or --device with "
            "a running device"
        )
    _refuse_unused(context, readings, device, calibration, output)
    target = Wand(_positions(positions), position_sigma)
    strobed = (
        [0, 1] if strobe_markers is None else numbers(strobe_markers, "--strobe-markers", "0,1")
    )
    if readings is None and len(strobed) != len(target):
        raise InvalidParameter(
            f'--strobe-markers is "{strobe_markers or "0,1"}"; the wand has {len(target)} markers: '
            "give the strobed marker of each"
        )
    cameras = None if calibration is None else read_calibration(calibration).calibration.models
    geometry: tuple[SensorGeometry, ...] = ()
    if readings is not None:
        table = read_wand(readings, len(target))
        if cameras is None:
            table, geometry = with_geometry(table, sensors, pixels)
    elif recording is not None:
        with progress("finding peaks", 1.0, quiet=as_json) as report:
            table, geometry = read_recorded_wand(recording, strobed, report)
    else:
        assert device is not None
        with client_session(url, key) as client:
            source = LiveWand(client, device, strobed)
            geometry = source.sensors
            table = wave_live(source, target, cameras, seconds, quiet=as_json)
    initial: tuple[SensorModel, ...] | tuple[SensorGeometry, ...]
    if cameras is not None:
        initial = cameras
        table = table.in_order_of(cameras, str(calibration))
    else:
        initial = geometry
    waved = Recording(target, table.readings_px, table.sigma_px)
    try:
        with progress("calibrating", 1.0, quiet=as_json) as report:
            result = self_calibrate(
                initial,
                [waved],
                initial="readings" if from_readings or calibration is None else "start",
                directions_deg=(
                    None if directions is None else _directions(directions, table.sensors)
                ),
                distortion=parse_distortion(distortion),
                progress=lambda share, _stage: report(CALIBRATION_SHARE * share),
            )
            held_out = held_out_lengths(
                result,
                [waved],
                lambda share, _stage: report(CALIBRATION_SHARE + (1.0 - CALIBRATION_SHARE) * share),
            )
    except LumilineError:
        if readings is None and not as_json:
            show_coverage(wave_coverage(initial, waved, cameras))
        raise
    if output is not None:
        write_calibration(output, result.calibration, quiet=as_json)
    if as_json:
        print_json(_figures(result, held_out))
        return
    if readings is None:
        show_coverage(wave_coverage(initial, waved, result.calibration.models))
    fit = result.targets[0]
    console.print(fit_table(result.calibration, f"{table.path}: {fit.used} of {fit.poses} poses"))
    if fit.length_error_mm is not None:
        span = float(np.ptp(np.array(target.position_mm)))
        say(f"the wand of {span:g} mm, marker by marker: {fit.length_error_mm:.3g} mm RMS off")
    if held_out is not None:
        say(
            f"its lengths at {held_out.poses} poses, held out in turn: {held_out.rms_mm:.3g} mm "
            f"RMS off, {held_out.mean_mm:+.3g} mm on average"
        )
    say(f"chi2 {result.chi2_per_dof:.3g} a degree of freedom")
    if result.device_scale is not None:
        say(f"the device is {result.device_scale:.4g} times as large as in {calibration}")
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


def _refuse_unused(
    context: typer.Context,
    readings: Path | None,
    device: str | None,
    calibration: Path | None,
    output: Path | None,
) -> None:
    if device is None:
        refuse_unused(context, "without --device", "seconds", "url", "key")
    if readings is not None:
        refuse_unused(context, "on a CSV file, which names the markers", "strobe_markers")
    else:
        refuse_unused(context, "here: the device's sensors are known", "sensors", "pixels")
    if calibration is None:
        refuse_unused(context, "without --calibration", "from_readings")
    else:
        refuse_unused(context, "with --calibration, which has the sensors", "sensors", "pixels")
    if context.params["sensors"] is not None:
        refuse_unused(context, "with --sensors, which says them of each", "pixels")
    if output is None:
        refuse_unused(context, "without --output", "force")


def _figures(result: SelfCalibration, held_out: HeldOutLengths | None) -> dict[str, Any]:
    """Return what is printed, for machines."""
    return {
        "calibration": DOCUMENT.dump_python(result.calibration, mode="json"),
        "targets": [
            {name: value for name, value in asdict(one).items() if name != "markers_mm"}
            for one in result.targets
        ],
        "lengths_left_out": None if held_out is None else asdict(held_out),
        "chi2_per_dof": result.chi2_per_dof,
        "device_scale": result.device_scale,
        "warnings": list(result.warnings),
        "exchanged": [asdict(one) for one in result.exchanged],
        "rejected": [asdict(one) for one in result.rejected],
    }


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


def _positions(text: str) -> tuple[float, ...]:
    """Return the markers' positions; raises InvalidParameter."""
    try:
        return tuple(float(part) for part in text.replace(",", " ").split())
    except ValueError:
        raise InvalidParameter(
            f'positions is "{text}"; it must be the markers\' positions along the wand in mm, '
            'for example "0 300"'
        ) from None
