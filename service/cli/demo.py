"""`lumiline demo`: the main job, end to end, as a client of the real service."""

import shutil
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from benchmarks.live import summarise
from compute.calibration.result import AxisErrors
from hardware.simulated.scenes import CalibrationTarget, RotatingBar
from lumiline.client.errors import ClientError
from service.cli.demo_client import DemoClient
from service.cli.demo_picture import save_picture
from service.cli.options import AsJson, Force
from service.cli.output import (
    check_folder,
    check_output,
    console,
    error_table,
    fail,
    make_table,
    millimetres,
    print_json,
    progress,
    say,
)
from service.cli.service_process import service_process
from validation.published_errors import DLT, PUBLISHED

FRAME_SECONDS = 3.0
BAR = RotatingBar()
FRAME = CalibrationTarget()


def demo(
    output: Annotated[Path, typer.Option(help="Folder for the picture, database and log.")] = Path(
        "demo-output"
    ),
    seconds: Annotated[float, typer.Option(min=2.0, help="How long the bar is streamed.")] = 5.0,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Start the service, calibrate, stream, print the figures and write the picture."""
    data, picture = output / "data", output / "demo.png"
    check_folder(output)
    if output.is_dir():
        check_output(picture, force=force)
    if data.exists() and not force:
        raise fail(f"{data} exists; choose another --output, or overwrite it with --force")
    # Figures are shown as they come; machines get all of them at the end.
    console.quiet = as_json
    shutil.rmtree(data, ignore_errors=True)
    doing = "starting the service (the first time it compiles its kernels)"
    try:
        with (
            service_process(data, doing=doing, quiet=as_json) as service,
            DemoClient(service.url) as client,
        ):
            say(f"service: {service.url}  (SQLite in {data}, log in {data / 'service.log'})")
            figures = {
                "measured_frames": _measured_frames(client),
                "simulated_calibration": _simulated_calibration(client),
                "rotating_bar": _rotating_bar(client, seconds, picture),
            }
        say(f"to look at it in the browser: lumiline serve --data-dir {data} --open")
    except (RuntimeError, ClientError) as error:
        raise fail(str(error)) from error
    finally:
        console.quiet = False
    if as_json:
        print_json({**figures, "picture": str(picture), "data": str(data)})


def _measured_frames(client: DemoClient) -> dict[str, Any]:
    """Tests 5.3 and 5.4 of the thesis: 19 LEDs, 4 sensors, as measured."""
    client.create_thesis_device()
    figures = {}
    for number, distance in (("5.3", "3 m"), ("5.4", "1 m")):
        with progress(f"calibrating with the frame at {distance}"):
            calibration = client.calibrate_thesis_frame(number)
        errors = calibration["errors"]
        figures[f"test-{number}"] = {
            name: errors[name]["statistics"] for name in ("fitted", "leave_one_out")
        }
        console.print()
        console.print(
            error_table(
                f"measured frame at {distance} (thesis Test {number}): 19 LEDs, 4 sensors\n"
                "absolute errors in mm",
                [
                    (DLT, PUBLISHED[f"test-{number}"][DLT], "dim"),
                    ("Lumiline, fitted", _axis_errors(errors["fitted"]), ""),
                    ("Lumiline, leave one out", _axis_errors(errors["leave_one_out"]), ""),
                ],
            )
        )
    return figures


def _axis_errors(document: dict[str, Any]) -> AxisErrors:
    return AxisErrors(**document["statistics"])


def _simulated_calibration(client: DemoClient) -> dict[str, Any]:
    """Calibrate the simulated device with the peaks of a frame that it sees."""
    client.show(asdict(FRAME))
    with progress("observing the simulated frame", FRAME_SECONDS) as report:
        observed = client.observe_frame(FRAME_SECONDS, report)
    with progress("calibrating the simulated device"):
        calibration = client.calibrate_simulated(FRAME.points(0.0), observed)
    headings = ("sensor", "points", "rms, px", "reading sigma, px", "chi2/dof")
    rows = (
        (fit["model"]["name"], fit["points"], f"{fit['rms_px']:.4f}", f"{fit['sigma_px']:.4f}",
         f"{fit['chi2_per_dof']:.2f}")
        for fit in calibration["result"]["sensors"]
    )  # fmt: skip
    title = f"simulated device calibrated: {calibration['point_count']} markers"
    console.print()
    console.print(make_table(headings, rows, title))
    left_out = _axis_errors(calibration["errors"]["leave_one_out"])
    console.print(
        "mean absolute error, leave one out, X Y Z, mm: "
        + " ".join(millimetres(value) for value in left_out.mean_absolute_mm)
    )
    return {
        "points": calibration["point_count"],
        "rms_px": [fit["rms_px"] for fit in calibration["result"]["sensors"]],
        "leave_one_out": asdict(left_out),
    }


def _rotating_bar(client: DemoClient, seconds: float, picture: Path) -> dict[str, Any]:
    """Stream the bar of section 6.1.2 and print what came of it."""
    client.show(asdict(BAR))
    with progress("streaming the rotating bar", seconds) as report:
        stream = client.stream_bar(seconds, report)
    figures = summarise(
        stream.sequence, stream.latency_ns, stream.exposure_ns[0], stream.exposure_ns[-1]
    )
    time, first, second = stream.ends()
    length = np.linalg.norm(first - second, axis=1)
    rows = (
        ("duration, s", f"{figures.seconds:.2f}"),
        ("frames received", figures.frames),
        ("frames/s", f"{figures.frames_per_s:.1f}"),
        ("frames lost", figures.lost),
        ("messages missed", stream.missed),
        ("latency, exposure to client, p50, ms", f"{figures.latency_ms['p50']:.2f}"),
        ("latency, exposure to client, p99, ms", f"{figures.latency_ms['p99']:.2f}"),
        ("bar length, true, mm", f"{BAR.length_mm:.3f}"),
        ("bar length, mean, mm", f"{length.mean():.3f}"),
        ("bar length, standard deviation, mm", f"{length.std(ddof=1):.3f}"),
    )
    console.print()
    console.print(
        make_table(("figure", "value"), rows, "rotating bar, streamed over the websocket")
    )
    with progress("drawing"):
        save_picture(
            picture, time, (first, second), BAR.length_mm, np.array(stream.latency_ns) / 1e6
        )
    say(f"picture: {picture}")
    return {
        **asdict(figures),
        "messages_missed": stream.missed,
        "bar_length_mm": {
            "true": BAR.length_mm,
            "mean": float(length.mean()),
            "standard_deviation": float(length.std(ddof=1)),
        },
    }
